//! `gakp tune`: tunes the noise of the Kalman filter on MOTChallenge folders or on a simulated world.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use indicatif::{ProgressBar, ProgressStyle};

use crate::learn::dataset;
use crate::learn::tune::recording::{folders_without_truth, with_truth, without_truth};
use crate::learn::tune::{
    Consistency, Cost, Group, HORIZONS, Measured, Recording, Search, Settings, Statistic, Tuned, World,
    measure, noise, plot, scaled, tune,
};
use crate::track::FilterConfig;
use crate::tuning::{FilterTuning, Origin, Tuning};

/// Filters that `--polish` tries on the simulated world.
const POLISH_SIMULATED: u64 = 120;

/// Tunes the noise of the Kalman filter by Bayesian optimisation of its consistency.
///
/// ROOTs are MOTChallenge sequences (gt/gt.txt, det/det.txt, seqinfo.ini) or folders of them. Errors are
/// held against the truth (NEES) or, with --nis, against the detections (NIS; gt/gt.txt is not needed).
/// Prints the consistency before and after, and writes a file that `gakp serve` and `gakp track` take
/// with --tuning. The same input and settings give the same file.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Sequences, or folders of sequences.
    #[arg(required_unless_present = "simulated", value_name = "ROOT")]
    pub roots: Vec<PathBuf>,
    /// Tuning file to write; with --loso a folder, for one file each footage.
    #[arg(long, required_unless_present = "simulated", value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Leave out every sequence whose footage or name contains this.
    #[arg(long, value_name = "TEXT", conflicts_with = "simulated")]
    pub exclude: Vec<String>,
    /// Leave one sequence out: for each footage that contains TEXT (all, without it) a tuning that has
    /// seen none of its copies, OUT/FOOTAGE.toml; its consistency is printed for the footage left out.
    #[arg(long, value_name = "TEXT", num_args = 0..=1, default_missing_value = "", conflicts_with = "simulated")]
    pub loso: Option<String>,
    /// Of sequences whose names end in -SUFFIX take the second half alone (their detector was trained on
    /// the first).
    #[arg(long, value_name = "SUFFIX", conflicts_with = "simulated")]
    pub second_half: Vec<String>,
    /// Hold errors against the detections (NIS), not against truth (NEES); the tracker says which
    /// detections are one person's.
    #[arg(long)]
    pub nis: bool,
    /// Tune on a simulated world whose noise is known, from filters whose Q and R are ten times too large
    /// or too small, and check each on a second such world.
    #[arg(long, conflicts_with = "roots")]
    pub simulated: bool,
    /// Filters to try, for the noise of the centre and again for that of the size.
    #[arg(long, default_value_t = Settings::default().search.evaluations as u64, value_parser = clap::value_parser!(u64).range(10..=10_000))]
    pub evaluations: u64,
    /// Filters to try after that, near the best one, by an evolution strategy (CMA-ES) that follows flat valleys:
    /// 120 with --simulated if not given, where the truth is the filter's own model, otherwise none.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(0..=10_000))]
    pub polish: Option<u64>,
    /// What is made small: `likelihood` (negative log-likelihood of what the errors are held against) or
    /// `consistency` (|ln(mean / n)| as Chen et al. have it, over several horizons).
    #[arg(long, default_value = Cost::default().name(), value_parser = cost)]
    pub cost: Cost,
    /// Share of the largest errors that the cost leaves out, from 0 to less than 0.5.
    #[arg(long, value_name = "SHARE", default_value_t = Settings::default().trim)]
    pub trim: f64,
    /// Seed of everything random.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Draw the consistency before and after (SVG); with --loso a folder, for one picture each footage.
    #[arg(long, value_name = "FILE")]
    pub plot: Option<PathBuf>,
}

fn cost(name: &str) -> Result<Cost, String> {
    let all = [Cost::Likelihood, Cost::Consistency];
    all.into_iter().find(|c| c.name() == name).ok_or_else(|| "expected likelihood or consistency".into())
}

impl Args {
    fn settings(&self) -> Result<Settings> {
        let default = Settings::default();
        let trim = self.trim;
        ensure!((0.0..0.5).contains(&trim), "--trim {trim}: must be from 0 to less than 0.5");
        Ok(Settings {
            statistic: if self.nis { Statistic::Nis } else { Statistic::Nees },
            cost: self.cost,
            trim,
            search: Search {
                evaluations: self.evaluations as usize,
                polish: self.polish.unwrap_or(if self.simulated { POLISH_SIMULATED } else { 0 }) as usize,
                seed: self.seed,
                ..default.search
            },
        })
    }
}

/// Runs the command.
///
/// # Errors
/// Data that cannot be read, is wrong or tells nothing, names that match nothing, and files that cannot
/// be written.
pub fn run(args: Args) -> Result<()> {
    let settings = args.settings()?;
    if args.simulated {
        return simulated(&args, &settings);
    }
    let out = args.out.as_deref().context("--out FILE is needed: where to write the tuning")?;
    let recordings = load(&args)?;
    match &args.loso {
        Some(name) => {
            let mut groups: Vec<&str> = recordings.iter().map(|r| r.group.as_str()).collect();
            groups.retain(|g| g.contains(name.as_str()));
            groups.sort_unstable();
            groups.dedup();
            ensure!(!groups.is_empty(), "--loso {name:?}: no footage has that in its name");
            for folder in [Some(out), args.plot.as_deref()].into_iter().flatten() {
                fs::create_dir_all(folder).with_context(|| format!("cannot create {}", folder.display()))?;
            }
            for group in groups {
                let (held, seen): (Vec<_>, Vec<_>) = recordings.iter().partition(|r| r.group == group);
                ensure!(!seen.is_empty(), "nothing to tune on: {group} is the only footage");
                let plot = args.plot.as_ref().map(|folder| folder.join(format!("{group}.svg")));
                let file = out.join(format!("{group}.toml"));
                on_recordings(&settings, &seen, &held, group, &file, plot.as_deref())?;
            }
            Ok(())
        }
        None => {
            let seen: Vec<&Recording> = recordings.iter().collect();
            on_recordings(&settings, &seen, &[], "filter", out, args.plot.as_deref())
        }
    }
}

fn load(args: &Args) -> Result<Vec<Recording>> {
    let mut recordings = vec![];
    for root in &args.roots {
        let folders = if args.nis { folders_without_truth(root)? } else { dataset::folders(root)? };
        for folder in folders {
            let name = folder.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
            let ends = |suffix: &String| name.strip_suffix(suffix).is_some_and(|n| n.ends_with('-'));
            let half = args.second_half.iter().any(ends);
            recordings.push(if args.nis {
                without_truth(&folder, half)?
            } else {
                with_truth(&folder, half)?
            });
        }
    }
    recordings.sort_by(|a, b| a.name.cmp(&b.name));
    if let Some(pair) = recordings.windows(2).find(|w| w[0].name == w[1].name) {
        bail!("sequence {} is given twice", pair[0].name);
    }
    for text in &args.exclude {
        let matches = |r: &Recording| r.name.contains(text) || r.group.contains(text);
        ensure!(recordings.iter().any(matches), "--exclude {text:?}: no sequence has that in its name");
        recordings.retain(|r| !matches(r));
    }
    ensure!(!recordings.is_empty(), "nothing to tune on: every sequence is left out");
    Ok(recordings)
}

fn on_recordings(
    settings: &Settings,
    seen: &[&Recording],
    held: &[&Recording],
    name: &str,
    out: &Path,
    svg: Option<&Path>,
) -> Result<()> {
    let start = FilterConfig::hand_set();
    let tuned = with_bar(&start, seen, settings, name)?;
    let Settings { statistic, trim, .. } = *settings;
    let on = |filter: &FilterConfig, recordings: &[&Recording]| measure(filter, recordings, statistic);
    let (before, after) = (on(&start, seen), on(&tuned.filter, seen));
    println!(
        "{name}: {} sequences, cost of centre {} and size {}",
        seen.len(),
        arrow(&tuned, 0),
        arrow(&tuned, 1)
    );
    print_noise("hand-set", &start);
    print_noise("tuned", &tuned.filter);
    print_consistency(statistic, trim, &before, &after);
    if !held.is_empty() {
        println!("on {name}, left out:");
        print_consistency(statistic, trim, &on(&start, held), &on(&tuned.filter, held));
    }
    draw(svg, statistic, &before, &after)?;
    let data = seen.iter().map(|r| r.name.clone()).collect();
    write_tuning(out, settings, &tuned, data)
}

fn simulated(args: &Args, settings: &Settings) -> Result<()> {
    let world = World { seed: args.seed, ..World::default() };
    let other = World { seed: args.seed.wrapping_add(1_000_000), people: world.people / 2, ..world.clone() };
    let (recording, check) = (world.record(), other.record());
    println!(
        "a world of {} people, {} s each; checked on another of {}",
        world.people, world.seconds, other.people
    );
    print_noise("the world", &world.filter);
    let mut best: Option<Tuned> = None;
    for (q, r) in [(10.0, 10.0), (10.0, 0.1), (0.1, 10.0), (0.1, 0.1)] {
        let start = scaled(&world.filter, q, r);
        let name = format!("Q x {q}, R x {r}");
        let tuned = with_bar(&start, &[&recording], settings, &name)?;
        println!("\nstart with {name}: cost of centre {} and size {}", arrow(&tuned, 0), arrow(&tuned, 1));
        print_noise("start", &start);
        print_noise("tuned", &tuned.filter);
        let on =
            |filter: &FilterConfig, recording: &Recording| measure(filter, &[recording], settings.statistic);
        let (before, after) = (on(&start, &recording), on(&tuned.filter, &recording));
        print_consistency(settings.statistic, settings.trim, &before, &after);
        println!("on the other world:");
        let unseen = (on(&start, &check), on(&tuned.filter, &check));
        print_consistency(settings.statistic, settings.trim, &unseen.0, &unseen.1);
        if best.is_none_or(|b| tuned.after.iter().sum::<f64>() < b.after.iter().sum()) {
            draw(args.plot.as_deref(), settings.statistic, &before, &after)?;
            best = Some(tuned);
        }
    }
    match (&args.out, best) {
        (Some(out), Some(best)) => write_tuning(out, settings, &best, vec![recording.name]),
        _ => Ok(()),
    }
}

fn with_bar(start: &FilterConfig, on: &[&Recording], settings: &Settings, name: &str) -> Result<Tuned> {
    let form = "{msg} {wide_bar} {pos}/{len} {eta}";
    let style = ProgressStyle::with_template(form).unwrap_or_else(|_| ProgressStyle::default_bar());
    let bar =
        ProgressBar::new(2 * (settings.search.evaluations + settings.search.polish) as u64).with_style(style);
    let mut least: [f64; 2] = [f64::INFINITY; 2];
    let tuned = tune(start, on, settings, |group, trial| {
        let least = &mut least[group as usize];
        *least = least.min(trial.cost);
        bar.set_message(format!("{name}: {}, cost {least:.4}", group.name()));
        bar.inc(1);
    })?;
    bar.finish_and_clear();
    Ok(tuned)
}

fn arrow(tuned: &Tuned, group: usize) -> String {
    format!("{:.4} -> {:.4}", tuned.before[group], tuned.after[group])
}

fn print_noise(name: &str, filter: &FilterConfig) {
    let of = |group| noise(filter, group).map(|v| format!("{v:.4}")).join(" / ");
    println!(
        "  {name}: acceleration / walk / measurement of centre {}, of size {}",
        of(Group::Centre),
        of(Group::Size)
    );
}

/// The table before and after; a mean within its bounds is marked by `*`.
fn print_consistency(statistic: Statistic, trim: f64, before: &Measured, after: &Measured) {
    println!(
        "  {:<5} {:<8} {:<7} n {:>7} {:>10} {:>10}  {:<16} bulk ({} % left out) / n",
        statistic.name(),
        "after",
        "of",
        "samples",
        "before",
        "after",
        "95 % bounds",
        100.0 * trim
    );
    let row = |horizon: &str, of: &str, pair: Option<(Consistency, Consistency)>| {
        let Some((a, b)) = pair else { return };
        let mean = |c: &Consistency| format!("{:.3}{}", c.mean, if c.holds() { '*' } else { ' ' });
        println!(
            "  {:<5} {:<8} {:<7} {} {:>7} {:>10} {:>10}  {:.3} to {:<7.3} {:.3} -> {:.3}",
            "",
            horizon,
            of,
            a.n,
            a.count,
            mean(&a),
            mean(&b),
            a.bounds.0,
            a.bounds.1,
            a.bulk,
            b.bulk
        );
    };
    for (h, horizon) in HORIZONS.iter().enumerate() {
        for group in Group::ALL {
            row(&horizon.name(), group.name(), before.group(h, group, trim).zip(after.group(h, group, trim)));
        }
        row(&horizon.name(), "all", before.all(h, trim).zip(after.all(h, trim)));
    }
    row("update", "state", before.state(trim).zip(after.state(trim)));
}

fn draw(path: Option<&Path>, statistic: Statistic, before: &Measured, after: &Measured) -> Result<()> {
    let Some(path) = path else { return Ok(()) };
    write(path, &plot::consistency(statistic, before, after)?)
}

fn write_tuning(path: &Path, settings: &Settings, tuned: &Tuned, data: Vec<String>) -> Result<()> {
    let origin = Origin {
        statistic: settings.statistic.name().into(),
        cost: settings.cost.name().into(),
        data,
        evaluations: settings.search.evaluations,
        seed: settings.search.seed,
        cost_before: tuned.before,
        cost_after: tuned.after,
    };
    let tuning = Tuning { filter: FilterTuning::of(&tuned.filter), origin: Some(origin) };
    write(path, &tuning.to_toml()?)?;
    println!("wrote {}", path.display());
    Ok(())
}

fn write(path: &Path, text: &str) -> Result<()> {
    fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
}
