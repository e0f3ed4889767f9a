//! `gakp bench core`: what the tracker itself costs a frame, part by part, beside peers.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use serde::Serialize;

use super::super::models::ModelArgs;
use super::crowd;
use super::{run_peer, spread};
use crate::chart::{Line, Panel, svg};
use crate::infer::ModelConfig;
use crate::infer::bench::LinkAlone;
use crate::mot::{Sequence, SequenceInfo};
use crate::track::{Association, FrameInput, LinkRequest, Tracker, TrackerConfig};
use crate::types::{Detection, MediaTime};

/// Each way of tracking is timed over all sequences of a set, one frame after the other on one thread:
/// from a frame's detections to its tracks, the link network and the existence head included where the
/// way has them. Ways and peers take turns, round by round, so that a machine that slows down slows
/// all of them. Microseconds a frame: median over the rounds, least and most.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Folder of MOTChallenge sequences, each with det/det.txt and seqinfo.ini.
    root: PathBuf,
    /// Sets of detections: endings of the sequences' names, with commas between.
    #[arg(long, value_name = "SUFFIX", value_delimiter = ',', required = true)]
    det: Vec<String>,
    /// Only the second half of sequences of these sets.
    #[arg(long, value_name = "SUFFIX", value_delimiter = ',')]
    second_half: Vec<String>,
    /// Rounds.
    #[arg(long, default_value_t = 5, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1000))]
    rounds: u32,
    /// Command of peers, run by the shell with `ROOT SUFFIX [--second-half]` after it; it prints
    /// `NAME X us/frame` for each.
    #[arg(long, value_name = "COMMAND")]
    peer: Option<String>,
    /// Draw the cost of a frame against the people in it, up to 500 tracks and 500 detections, into this SVG.
    #[arg(long, value_name = "FILE")]
    plot: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    models: ModelArgs,
}

/// Runs the command.
///
/// # Errors
/// A sequence, the link network or the peer fails.
pub fn run(args: Args) -> Result<()> {
    let mut settings = ModelConfig::from(args.models.clone()).settings()?;
    settings.threads = Some(1);
    for det in &args.second_half {
        ensure!(args.det.contains(det), "--second-half {det}: it is not among the sets of --det");
    }
    let mut linker = LinkAlone::load(&settings)?;
    let ways = Way::all(&linker);
    let features = linker.calibrate(TrackerConfig::default()).association.features;
    ensure!(
        !features.see_appearance(),
        "the link network reads embeddings ({features}), and this bench has none: give --link one of boxes alone"
    );
    let mut report = Report { rounds: args.rounds, sets: vec![], crowd: vec![] };
    for det in &args.det {
        let half = args.second_half.contains(det);
        let set = load(&args.root, det, half)?;
        report.sets.push(measure(det, &set, half, &args, &ways, &mut linker)?);
    }
    if let Some(file) = &args.plot {
        report.crowd = crowd_costs(&ways, args.rounds, &mut linker)?;
        let drawn = svg(&[panel(&report.crowd)], 1)?;
        std::fs::write(file, drawn).with_context(|| format!("cannot write {}", file.display()))?;
    }
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report)?);
    } else {
        print(&report);
    }
    Ok(())
}

/// One way of tracking.
struct Way {
    name: &'static str,
    config: TrackerConfig,
}

impl Way {
    /// The whole step is the last one.
    fn all(linker: &LinkAlone) -> Vec<Self> {
        let way = |name, method: Association, head: bool| {
            let mut config = linker.calibrate(TrackerConfig::default());
            config.association.method = method;
            if !head {
                config.existence.head = None;
            }
            Way { name, config }
        };
        vec![
            way("IOU", Association::Iou, false),
            way("IOU + motion", Association::IouMotion, false),
            way("GAKP, no existence head", Association::Implicit, false),
            way("GAKP", Association::Implicit, true),
        ]
    }
}

/// The frames of one sequence.
struct Frames {
    name: String,
    size: (f64, f64),
    frame_rate: f64,
    detections: Vec<Vec<Detection>>,
}

impl Frames {
    fn boxes(&self) -> usize {
        self.detections.iter().map(Vec::len).sum()
    }

    fn boxes_a_frame(&self) -> f64 {
        self.boxes() as f64 / self.detections.len().max(1) as f64
    }
}

/// Where the time of a run went.
#[derive(Clone, Copy, Debug, Default)]
struct Spent {
    /// Prediction, camera motion, gate and features.
    predict: Duration,
    /// The link network.
    link: Duration,
    /// Assignment, filter update, births and deaths, existence head.
    update: Duration,
}

impl Spent {
    fn total(&self) -> Duration {
        self.predict + self.link + self.update
    }

    fn add(&mut self, other: Spent) {
        self.predict += other.predict;
        self.link += other.link;
        self.update += other.update;
    }
}

/// Tracks `frames` from the first to the last; of the first `warm_up` no time is counted.
fn track(way: &Way, frames: &Frames, warm_up: usize, linker: &mut LinkAlone) -> Result<Spent> {
    let mut tracker = Tracker::new(way.config.clone());
    let mut request = LinkRequest::default();
    let mut spent = Spent::default();
    for (index, detections) in frames.detections.iter().enumerate() {
        let frame = FrameInput {
            time: MediaTime::from_secs(index as f64 / frames.frame_rate),
            width: frames.size.0,
            height: frames.size.1,
            detections,
            embeddings: &[],
            shift: None,
        };
        let start = Instant::now();
        tracker.predict(frame, &mut request);
        let predicted = Instant::now();
        let links = if request.is_empty() { vec![] } else { linker.score(&request)? };
        let linked = Instant::now();
        std::hint::black_box(tracker.update(&links)?);
        if index >= warm_up {
            spent.add(Spent {
                predict: predicted - start,
                link: linked - predicted,
                update: linked.elapsed(),
            });
        }
    }
    Ok(spent)
}

/// The sequences `root/*-DET`.
fn load(root: &Path, det: &str, half: bool) -> Result<Vec<Frames>> {
    let entries =
        std::fs::read_dir(root).with_context(|| format!("cannot read folder {}", root.display()))?;
    let mut folders = vec![];
    for entry in entries {
        let folder = entry.with_context(|| format!("cannot read folder {}", root.display()))?.path();
        let name = folder.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        if name.strip_suffix(det).is_some_and(|rest| rest.ends_with('-')) {
            folders.push((name, folder));
        }
    }
    folders.sort();
    ensure!(!folders.is_empty(), "no sequence in {} ends in -{det}", root.display());
    let text = |file: PathBuf| {
        std::fs::read_to_string(&file).with_context(|| format!("cannot read {}", file.display()))
    };
    let read = |(name, folder): (String, PathBuf)| {
        let info = SequenceInfo::parse(&text(folder.join("seqinfo.ini"))?).with_context(|| name.clone())?;
        let rows = text(folder.join("det/det.txt"))?;
        let mut sequence = Sequence::parse(info, &rows).with_context(|| name.clone())?;
        if half {
            sequence = sequence.second_half();
        }
        Ok(Frames {
            name,
            size: (f64::from(sequence.info.width), f64::from(sequence.info.height)),
            frame_rate: sequence.info.frame_rate,
            detections: sequence.detections,
        })
    };
    folders.into_iter().map(read).collect()
}

#[derive(Serialize)]
struct Report {
    rounds: u32,
    sets: Vec<SetReport>,
    crowd: Vec<CrowdRow>,
}

#[derive(Serialize)]
struct SetReport {
    name: String,
    frames: usize,
    boxes_a_frame: f64,
    ways: Vec<WayReport>,
    /// The sequence with the most boxes a frame, by the whole step.
    densest: DensestReport,
    /// Peers: microseconds a frame, median, least, most.
    peers: Vec<(String, [f64; 3])>,
    /// The fastest peer over IOU + motion, round by round: above 1, ours is faster.
    fastest_peer_ratio: Option<[f64; 3]>,
}

#[derive(Serialize)]
struct WayReport {
    name: &'static str,
    /// Microseconds a frame: median, least, most.
    us: [f64; 3],
    /// Medians of the parts.
    predict_us: f64,
    link_us: f64,
    update_us: f64,
}

#[derive(Serialize)]
struct DensestReport {
    sequence: String,
    boxes_a_frame: f64,
    us: [f64; 3],
}

/// One point of the plot.
#[derive(Serialize)]
struct CrowdRow {
    /// Tracks, and detections a frame.
    people: usize,
    /// Pairs of overlapping people a frame.
    pairs: f64,
    /// Milliseconds a frame of each way: median over the rounds.
    ms: Vec<(&'static str, f64)>,
}

fn measure(
    det: &str,
    set: &[Frames],
    half: bool,
    args: &Args,
    ways: &[Way],
    linker: &mut LinkAlone,
) -> Result<SetReport> {
    let frames: usize = set.iter().map(|s| s.detections.len()).sum();
    let densest = set.iter().max_by(|a, b| a.boxes_a_frame().total_cmp(&b.boxes_a_frame()));
    let densest = densest.with_context(|| format!("no sequence of {det}"))?;
    // By way, by round.
    let mut spent = vec![vec![]; ways.len()];
    let mut dense = vec![];
    let mut peers: Vec<Vec<(String, f64)>> = vec![];
    for _ in 0..args.rounds {
        for (way, spent) in ways.iter().zip(&mut spent) {
            let mut all = Spent::default();
            for sequence in set {
                let one = track(way, sequence, 0, linker)?;
                if std::ptr::eq(sequence, densest) && way.name == ways[ways.len() - 1].name {
                    dense.push(us(one.total(), sequence.detections.len()));
                }
                all.add(one);
            }
            spent.push(all);
        }
        if let Some(command) = &args.peer {
            peers.push(peer_times(command, &args.root, det, half)?);
        }
    }
    let ways: Vec<WayReport> = ways
        .iter()
        .zip(&spent)
        .map(|(way, rounds)| {
            let part = |of: fn(&Spent) -> Duration| spread(rounds.iter().map(|s| us(of(s), frames)));
            WayReport {
                name: way.name,
                us: part(Spent::total),
                predict_us: part(|s| s.predict)[0],
                link_us: part(|s| s.link)[0],
                update_us: part(|s| s.update)[0],
            }
        })
        .collect();
    let fastest = peers.iter().zip(&spent[1]).map(|(peers, own)| {
        let least = peers.iter().map(|(_, us)| *us).fold(f64::INFINITY, f64::min);
        least / us(own.total(), frames)
    });
    let names = peers.first().map(|first| first.iter().map(|(name, _)| name.clone()).collect::<Vec<_>>());
    let of_peer = |(i, name): (usize, String)| {
        let times = peers.iter().filter_map(|round| round.get(i)).map(|(_, us)| *us);
        (name, spread(times))
    };
    Ok(SetReport {
        name: det.to_owned(),
        frames,
        boxes_a_frame: set.iter().map(Frames::boxes).sum::<usize>() as f64 / frames.max(1) as f64,
        densest: DensestReport {
            sequence: densest.name.clone(),
            boxes_a_frame: densest.boxes_a_frame(),
            us: spread(dense.into_iter()),
        },
        fastest_peer_ratio: (!peers.is_empty()).then(|| spread(fastest)),
        peers: names.into_iter().flatten().enumerate().map(of_peer).collect(),
        ways,
    })
}

fn us(time: Duration, frames: usize) -> f64 {
    time.as_secs_f64() * 1e6 / frames.max(1) as f64
}

/// Every `NAME X us/frame` that the peer prints.
fn peer_times(command: &str, root: &Path, det: &str, half: bool) -> Result<Vec<(String, f64)>> {
    let quoted = |text: &str| format!("'{}'", text.replace('\'', r"'\''"));
    let half = if half { " --second-half" } else { "" };
    let text = run_peer(&format!("{command} {} {}{half}", quoted(&root.display().to_string()), quoted(det)))?;
    let line = |line: &str| {
        let (name, us) = line.strip_suffix(" us/frame")?.rsplit_once(' ')?;
        Some((name.to_owned(), us.parse().ok()?))
    };
    let found: Vec<_> = text.lines().filter_map(line).collect();
    ensure!(!found.is_empty(), "the peer printed no `NAME X us/frame`: {}", text.trim());
    Ok(found)
}

/// What a frame costs against the people in it.
fn crowd_costs(ways: &[Way], rounds: u32, linker: &mut LinkAlone) -> Result<Vec<CrowdRow>> {
    let mut rows = vec![];
    for people in crowd::SIZES {
        let frames = Frames {
            name: format!("crowd of {people}"),
            size: crowd::SIZE,
            frame_rate: crowd::FRAME_RATE,
            detections: crowd::detections(people),
        };
        let counted = frames.detections.len() - crowd::WARM_UP;
        let mut ms = vec![];
        for way in ways {
            let mut times = vec![];
            for _ in 0..rounds {
                times.push(us(track(way, &frames, crowd::WARM_UP, linker)?.total(), counted) / 1e3);
            }
            ms.push((way.name, spread(times.into_iter())[0]));
        }
        rows.push(CrowdRow { people, pairs: crowd::pairs(&frames.detections), ms });
    }
    Ok(rows)
}

fn panel(rows: &[CrowdRow]) -> Panel {
    let names = rows.first().map(|row| row.ms.iter().map(|(name, _)| *name)).into_iter().flatten();
    let line = |(i, name): (usize, &str)| {
        Line::new(name, rows.iter().map(|row| (row.people as f64, row.ms[i].1)).collect())
    };
    Panel {
        caption: "cost of a frame in a crowd, one thread".into(),
        axes: ["tracks, and detections a frame".into(), "ms a frame".into()],
        log: true,
        lines: names.enumerate().map(line).collect(),
    }
}

fn print(report: &Report) {
    let row = |name: &str, [median, least, most]: [f64; 3], more: String| {
        println!("  {name:<26} {median:9.2} ({least:.2} to {most:.2}){more}");
    };
    for set in &report.sets {
        println!(
            "{}: {} frames, {:.1} boxes a frame, {} rounds; us a frame",
            set.name, set.frames, set.boxes_a_frame, report.rounds
        );
        for way in &set.ways {
            let link = if way.link_us > 0.5 { format!(", link {:.1}", way.link_us) } else { String::new() };
            let parts = format!("   predict {:.1}{link}, update {:.1}", way.predict_us, way.update_us);
            row(way.name, way.us, parts);
        }
        let densest = &set.densest;
        let name = format!("GAKP, {}", densest.sequence);
        row(&name, densest.us, format!("   {:.1} boxes a frame", densest.boxes_a_frame));
        for (name, us) in &set.peers {
            row(name, *us, String::new());
        }
        if let Some(ratio) = set.fastest_peer_ratio {
            row("fastest peer / IOU + motion", ratio, String::new());
        }
    }
    if !report.crowd.is_empty() {
        println!("crowd; ms a frame");
    }
    for CrowdRow { people, pairs, ms } in &report.crowd {
        let costs: Vec<String> = ms.iter().map(|(name, ms)| format!("{name} {ms:.3}")).collect();
        println!("  {people:3} x {people:<3} {pairs:6.0} overlapping pairs   {}", costs.join(", "));
    }
}
