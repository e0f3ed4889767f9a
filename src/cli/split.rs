//! `gakp split`: cuts a MOTChallenge sequence in two.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};

use crate::mot::{
    Matrix, Row, SequenceInfo, first_half_length, footage, parse_detections, parse_npy, parse_truth,
    write_npy,
};

/// Cuts MOTChallenge sequences in halves, so that what is learned on one half of an only sequence can be
/// tested on the other.
///
/// MOT17-05-FRCNN becomes OUT/MOT17-05a-FRCNN and OUT/MOT17-05b-FRCNN: two footages to every other command,
/// so `gakp train OUT --loso` trains on each half and tests on the other. Truth, detections, their
/// features and seqinfo.ini are cut, pictures are not copied. The first half of L frames has L/2 + 1.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Sequences, each a folder with gt/gt.txt, det/det.txt and seqinfo.ini.
    #[arg(required = true, value_name = "SEQUENCE")]
    pub sequences: Vec<PathBuf>,
    /// Folder to write to.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
}

/// Runs the command.
///
/// # Errors
/// A sequence that cannot be read, is wrong or too short, and files that cannot be written.
pub fn run(args: Args) -> Result<()> {
    for folder in &args.sequences {
        split(folder, &args.out).with_context(|| format!("cannot split {}", folder.display()))?;
    }
    Ok(())
}

fn split(folder: &Path, out: &Path) -> Result<()> {
    let text =
        |file: &str| fs::read_to_string(folder.join(file)).with_context(|| format!("{file} cannot be read"));
    let info = SequenceInfo::parse(&text("seqinfo.ini")?).context("seqinfo.ini")?;
    ensure!(info.length > 2, "it has {} frames, halves need 3 at least", info.length);
    let (truth, detections) = (text("gt/gt.txt")?, text("det/det.txt")?);
    let truth_rows = parse_truth(&truth, Some(info.length)).context("gt/gt.txt")?;
    let detection_rows = parse_detections(&detections, Some(info.length)).context("det/det.txt")?;
    let features = folder.join("det/det_features.npy");
    let features = match features.is_file() {
        true => {
            let matrix = parse_npy(&fs::read(&features).context("det/det_features.npy cannot be read")?)
                .context("det/det_features.npy")?;
            ensure!(
                matrix.rows == detection_rows.len(),
                "det/det_features.npy has {} rows, det/det.txt {}",
                matrix.rows,
                detection_rows.len()
            );
            Some(matrix)
        }
        false => None,
    };
    let name =
        folder.canonicalize()?.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let of = footage(&name);
    let first = first_half_length(info.length);
    for (letter, frames) in [("a", 0..first), ("b", first..info.length)] {
        let name = format!("{of}{letter}{}", &name[of.len()..]);
        let to = out.join(&name);
        ensure!(!to.exists(), "{} is there already: give an empty folder", to.display());
        let info = SequenceInfo { name: name.clone(), length: frames.len() as u32, ..info.clone() };
        let kept = |row: &Row| frames.contains(&(row.frame - 1));
        write(&to.join("seqinfo.ini"), info.write().as_bytes())?;
        let rows = cut(&truth, &truth_rows, frames.start, kept);
        write(&to.join("gt/gt.txt"), rows.as_bytes())?;
        let rows = cut(&detections, &detection_rows, frames.start, kept);
        write(&to.join("det/det.txt"), rows.as_bytes())?;
        if let Some(matrix) = &features {
            let part = cut_features(matrix, &detection_rows, frames.start, kept);
            write(&to.join("det/det_features.npy"), &write_npy(&part))?;
        }
        let detections = detection_rows.iter().filter(|row| kept(row)).count();
        println!("{}: {} frames, {detections} detections", to.display(), frames.len());
    }
    Ok(())
}

/// The lines of the rows that are kept, as they stand, their frames counted from `start` on.
fn cut(text: &str, rows: &[Row], start: u32, kept: impl Fn(&Row) -> bool) -> String {
    let lines = text.trim_start_matches('\u{feff}').lines().map(str::trim).filter(|line| !line.is_empty());
    let kept = lines.zip(rows).filter(|(_, row)| kept(row));
    kept.map(|(line, row)| {
        let rest = line.find(|c: char| c == ',' || c.is_whitespace()).unwrap_or(line.len());
        format!("{}{}\n", row.frame - start, &line[rest..])
    })
    .collect()
}

/// The features of the rows that are kept. A first column that repeats the frame is counted anew.
fn cut_features(matrix: &Matrix, rows: &[Row], start: u32, kept: impl Fn(&Row) -> bool) -> Matrix {
    let repeats = (0..rows.len()).all(|i| matrix.row(i).starts_with(&[f64::from(rows[i].frame), -1.0]));
    let mut part = Matrix { rows: 0, columns: matrix.columns, values: vec![] };
    for (index, row) in rows.iter().enumerate().filter(|(_, row)| kept(row)) {
        let at = part.values.len();
        part.values.extend_from_slice(matrix.row(index));
        if repeats {
            part.values[at] = f64::from(row.frame - start);
        }
        part.rows += 1;
    }
    part
}

fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    let folder = path.parent().unwrap_or(path);
    fs::create_dir_all(folder).with_context(|| format!("cannot create {}", folder.display()))?;
    fs::write(path, bytes).with_context(|| format!("cannot write {}", path.display()))
}
