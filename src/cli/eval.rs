//! `gakp eval`: scores result files against MOTChallenge truth.

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use serde::Serialize;

use crate::mot::{
    Benchmark, Score, SequenceInfo, evaluate, first_half_length, parse_results, parse_truth, second_half,
};

/// Scores tracks against MOTChallenge ground truth: HOTA, CLEAR MOT and identity measures.
///
/// The figures are those of TrackEval 1.3.0 (MotChallenge2DBox, pedestrians). Whether MOT15's rules
/// (no classes) or those of MOT16, MOT17 and MOT20 hold is told by the columns of gt.txt.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Folder of sequence folders, each with gt/gt.txt and seqinfo.ini.
    #[arg(long, value_name = "ROOT")]
    pub gt: PathBuf,
    /// Folder with a file SEQ.txt for every sequence, or with them in a folder `data`.
    #[arg(long, value_name = "DIR")]
    pub results: PathBuf,
    /// Only sequences whose names end in -SUFFIX (MOTChallenge's copies by detector: DPM, FRCNN, SDP).
    #[arg(long, value_name = "SUFFIX")]
    pub det: Option<String>,
    /// Score frames after L/2 + 1 of every sequence of L frames; frame 1 of the results is the first of
    /// these.
    #[arg(long)]
    pub second_half: bool,
    /// Print JSON: percentages at full precision.
    #[arg(long)]
    pub json: bool,
}

/// The figures of one sequence, or of all of them. The names are the field's; scores are percentages.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(rename_all = "UPPERCASE")]
#[allow(missing_docs, reason = "each is defined at the method of crate::mot that gives it")]
pub struct Figures {
    pub hota: f64,
    #[serde(rename = "DetA")]
    pub det_a: f64,
    #[serde(rename = "AssA")]
    pub ass_a: f64,
    pub mota: f64,
    pub idf1: f64,
    pub mt: u64,
    pub ml: u64,
    pub fp: u64,
    #[serde(rename = "FN")]
    pub fn_: u64,
    #[serde(rename = "IDs")]
    pub ids: u64,
    #[serde(rename = "Frag")]
    pub frag: u64,
    pub motp: f64,
    pub pt: u64,
    pub tp: u64,
    #[serde(rename = "LocA")]
    pub loc_a: f64,
    #[serde(rename = "DetRe")]
    pub det_re: f64,
    #[serde(rename = "DetPr")]
    pub det_pr: f64,
    #[serde(rename = "AssRe")]
    pub ass_re: f64,
    #[serde(rename = "AssPr")]
    pub ass_pr: f64,
    pub idp: f64,
    pub idr: f64,
    pub idtp: u64,
    pub idfp: u64,
    pub idfn: u64,
}

impl From<&Score> for Figures {
    fn from(score: &Score) -> Self {
        let Score { hota, clear, identity } = score;
        Self {
            hota: 100.0 * hota.hota(),
            det_a: 100.0 * hota.det_a(),
            ass_a: 100.0 * hota.ass_a(),
            mota: 100.0 * clear.mota(),
            idf1: 100.0 * identity.idf1(),
            mt: clear.mt,
            ml: clear.ml,
            fp: clear.fp,
            fn_: clear.fn_,
            ids: clear.idsw,
            frag: clear.frag,
            motp: 100.0 * clear.motp(),
            pt: clear.pt,
            tp: clear.tp,
            loc_a: 100.0 * hota.loc_a(),
            det_re: 100.0 * hota.det_re(),
            det_pr: 100.0 * hota.det_pr(),
            ass_re: 100.0 * hota.ass_re(),
            ass_pr: 100.0 * hota.ass_pr(),
            idp: 100.0 * identity.idp(),
            idr: 100.0 * identity.idr(),
            idtp: identity.tp,
            idfp: identity.fp,
            idfn: identity.fn_,
        }
    }
}

/// Figures by sequence and combined.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// In the order of the names.
    pub sequences: Vec<SequenceReport>,
    /// All sequences together.
    pub combined: Figures,
}

/// Figures of a sequence.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SequenceReport {
    /// Name of its folder.
    pub name: String,
    /// Frames that were scored.
    pub frames: u32,
    /// Its figures.
    #[serde(flatten)]
    pub figures: Figures,
}

/// Runs the command.
///
/// # Errors
/// A folder or file that is missing or cannot be read, or a row that is wrong; see [`score`].
pub fn run(args: Args) -> Result<()> {
    let report = score(&args)?;
    let text = match args.json {
        true => serde_json::to_string_pretty(&report)? + "\n",
        false => table(&report),
    };
    std::io::stdout().write_all(text.as_bytes()).context("cannot write to standard output")
}

/// Scores what `args` name.
///
/// # Errors
/// No sequence under the root, a sequence without results, and files that are missing, cannot be read
/// or are wrong: the message names the file, the line and what was expected.
pub fn score(args: &Args) -> Result<Report> {
    let mut scores = Vec::new();
    let mut sequences = Vec::new();
    for (name, folder) in sequence_folders(&args.gt, args.det.as_deref())? {
        let (score, frames) = score_sequence(args, &name, &folder)?;
        sequences.push(SequenceReport { name, frames, figures: Figures::from(&score) });
        scores.push(score);
    }
    let combined = Figures::from(&Score::combine(&scores.iter().collect::<Vec<_>>()));
    Ok(Report { sequences, combined })
}

fn score_sequence(args: &Args, name: &str, folder: &Path) -> Result<(Score, u32)> {
    let ini = folder.join("seqinfo.ini");
    let info = SequenceInfo::parse(&read(&ini)?).with_context(|| ini.display().to_string())?;
    let file = folder.join("gt/gt.txt");
    let mut truth =
        parse_truth(&read(&file)?, Some(info.length)).with_context(|| file.display().to_string())?;
    let mut frames = info.length;
    if args.second_half {
        truth = second_half(&truth, info.length);
        frames = info.length.saturating_sub(first_half_length(info.length));
    }
    let file = result_file(&args.results, name)?;
    let results = parse_results(&read(&file)?, Some(frames)).with_context(|| file.display().to_string())?;
    let score =
        evaluate(&truth, &results, frames, Benchmark::of(name, &truth)).with_context(|| name.to_string())?;
    Ok((score, frames))
}

fn read(path: &Path) -> Result<String> {
    std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))
}

/// Names and paths of the folders under `root` that hold truth, in the order of their names.
fn sequence_folders(root: &Path, det: Option<&str>) -> Result<Vec<(String, PathBuf)>> {
    let entries =
        std::fs::read_dir(root).with_context(|| format!("cannot read folder {}", root.display()))?;
    let mut found = Vec::new();
    for entry in entries {
        let entry = entry.with_context(|| format!("cannot read folder {}", root.display()))?;
        let name = entry.file_name().to_string_lossy().into_owned();
        let wanted = det.is_none_or(|det| name.strip_suffix(det).is_some_and(|rest| rest.ends_with('-')));
        if wanted && entry.path().join("gt/gt.txt").is_file() {
            found.push((name, entry.path()));
        }
    }
    found.sort();
    if found.is_empty() {
        let pattern = det.map_or("SEQ".to_string(), |det| format!("SEQ-{det}"));
        bail!(
            "no sequence in {}: expected folders {pattern}/ with gt/gt.txt and seqinfo.ini",
            root.display()
        );
    }
    Ok(found)
}

fn result_file(folder: &Path, sequence: &str) -> Result<PathBuf> {
    let name = format!("{sequence}.txt");
    let places = [folder.join(&name), folder.join("data").join(&name)];
    if let Some(file) = places.iter().find(|file| file.is_file()) {
        return Ok(file.clone());
    }
    let [first, second] = places.map(|file| file.display().to_string());
    bail!(
        "no results for sequence {sequence}: expected {first} or {second} (an empty file where nothing was \
         tracked; --det SUFFIX picks sequences)"
    )
}

/// The figures that papers print, in columns.
fn table(report: &Report) -> String {
    const HEAD: [&str; 11] = ["HOTA", "DetA", "AssA", "MOTA", "IDF1", "MT", "ML", "FP", "FN", "IDs", "Frag"];
    let names = report.sequences.iter().map(|s| s.name.as_str());
    let lines: Vec<(&str, &Figures)> = names
        .zip(report.sequences.iter().map(|s| &s.figures))
        .chain([("COMBINED", &report.combined)])
        .collect();
    let width = lines.iter().map(|(name, _)| name.chars().count()).max().unwrap_or(0);
    let mut out = format!("{:width$}", "");
    for title in HEAD {
        let _ = write!(out, " {title:>7}");
    }
    out.push('\n');
    for (name, f) in lines {
        let _ = write!(out, "{name:width$}");
        for score in [f.hota, f.det_a, f.ass_a, f.mota, f.idf1] {
            let _ = write!(out, " {score:7.2}");
        }
        for count in [f.mt, f.ml, f.fp, f.fn_, f.ids, f.frag] {
            let _ = write!(out, " {count:7}");
        }
        out.push('\n');
    }
    out
}
