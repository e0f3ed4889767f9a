//! `gakp train`: trains the link network on MOTChallenge folders.

mod checkpoint;
mod report;
mod tracked;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::{fs, thread};

use anyhow::{Context, Result, bail, ensure};
use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;
use sha2::{Digest, Sha256};

use crate::learn::card::{Card, MOTCHALLENGE_LICENCE, Unseen};
use crate::learn::dataset::{self, LabelledSequence};
use crate::learn::network::Network;
use crate::learn::{Epoch, Fit, HeadFit, Looks, Recipe, Split, Teacher, fit_head};
use crate::track::{Association, Features, FilterConfig, TrackerConfig};
use crate::tuning::{FilterTuning, Tuning};
use checkpoint::CheckpointFile;
pub use report::Report;
use report::{Trained, curves};

/// Trains the network that says how probable it is that a detection continues a track.
///
/// ROOTs are MOTChallenge sequences (gt/gt.txt, det/det.txt, seqinfo.ini) or folders of them. Writes an
/// ONNX file and, beside it, a model card and a manifest. The same input and settings give the same file.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Sequences, or folders of sequences.
    #[arg(required = true, value_name = "ROOT")]
    pub roots: Vec<PathBuf>,
    /// ONNX file to write; with --loso a folder, for one file each footage.
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// Hold out every sequence whose footage or name contains this, and score the network on them.
    #[arg(long, value_name = "TEXT")]
    pub exclude: Vec<String>,
    /// Leave one sequence out: for each footage that contains TEXT (all, without it) a network that has
    /// seen none of its copies, OUT/FOOTAGE.onnx.
    #[arg(long, value_name = "TEXT", num_args = 0..=1, default_missing_value = "")]
    pub loso: Option<String>,
    /// Score sequences whose names end in -SUFFIX on their second half alone (their detector was trained
    /// on the first).
    #[arg(long, value_name = "SUFFIX")]
    pub second_half: Vec<String>,
    /// What to train: the GRU that gives the probability itself, or the one that gives the weights of
    /// explicit features.
    #[arg(long, value_name = "NAME", default_value = "implicit", value_parser = ["implicit", "explicit"])]
    pub association: String,
    /// What the network reads: boxes relative to the track; the same and how alike track and detection
    /// look; or, as the paper has it, embeddings and boxes themselves (spatial: the boxes alone). Those with
    /// appearance need det/det_features.npy in every sequence.
    #[arg(long, value_name = "NAME", default_value = "relative",
          value_parser = ["relative", "appearance", "literal", "spatial"])]
    pub features: String,
    /// Simulate the embeddings of sequences that have none, from the statistics of those that have some among
    /// the sequences that the network is trained on.
    #[arg(long)]
    pub simulate_looks: bool,
    /// Tuning file of `gakp tune`: the filter that the network will be used with. With --loso a folder
    /// that has FOOTAGE.toml of each.
    #[arg(long, value_name = "FILE")]
    pub tuning: Option<PathBuf>,
    /// Seed of everything random.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Passes over the examples, at most.
    #[arg(long, default_value_t = Fit::default().epochs as u64, value_parser = clap::value_parser!(u64).range(1..=1000))]
    pub epochs: u64,
    /// Stop after so many epochs without a lower loss on the validation pairs (the last of every sequence);
    /// 0 never does. The network of the best epoch is kept either way.
    #[arg(long, value_name = "EPOCHS", default_value_t = Fit::default().patience as u64)]
    pub patience: u64,
    /// Go on where an interrupted run of the same data and settings stopped. After every epoch a run leaves
    /// its state in OUT.checkpoint, and takes it away at its end.
    #[arg(long)]
    pub resume: bool,
    /// Draw the losses of the epochs into this SVG.
    #[arg(long, value_name = "FILE")]
    pub plot: Option<PathBuf>,
    /// Width of the hidden state: 32, and 134 (the paper's) for literal and spatial features.
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..=1024))]
    pub hidden: Option<u64>,
    /// Examples to make.
    #[arg(long, default_value_t = Recipe::default().examples as u64, value_parser = clap::value_parser!(u64).range(1000..=20_000_000))]
    pub examples: u64,
    /// Licence of the training data, for the card and the file.
    #[arg(long, value_name = "TEXT", default_value = MOTCHALLENGE_LICENCE, hide_default_value = true)]
    pub licence: String,
    /// Threads; they do not change the result.
    #[arg(long, value_name = "N")]
    pub threads: Option<usize>,
    /// Write the losses of the epochs and the scores on held-out sequences as JSON.
    #[arg(long, value_name = "FILE")]
    pub report: Option<PathBuf>,
    /// A report of a --loso run: its scores go into the model card.
    #[arg(long, value_name = "FILE")]
    pub unseen: Option<PathBuf>,
}

/// A sequence and where its files are.
#[derive(Clone)]
struct Source {
    folder: PathBuf,
    labelled: LabelledSequence,
}

/// Runs the command.
///
/// # Errors
/// Data that cannot be read or is wrong, names that match nothing, and files that cannot be written.
pub fn run(args: Args) -> Result<()> {
    let mut sources = load(&args.roots)?;
    let features = features(&args, &mut sources)?;
    let known = match &args.unseen {
        Some(path) => {
            let text = fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
            let report: Report =
                serde_json::from_str(&text).with_context(|| format!("{} is no report", path.display()))?;
            report.unseen
        }
        None => vec![],
    };
    let mut report = Report { epochs: vec![], unseen: known.clone() };
    if let Some(name) = &args.loso {
        let mut groups: Vec<&str> = sources.iter().map(|s| s.labelled.group.as_str()).collect();
        groups.retain(|g| g.contains(name.as_str()));
        groups.dedup();
        ensure!(!groups.is_empty(), "--loso {name:?}: no footage has that in its name");
        if args.simulate_looks {
            // Said before the first network is trained, not after hours at the last.
            for group in &groups {
                let seen: Vec<&Source> = sources.iter().filter(|s| s.labelled.group != *group).collect();
                ensure!(
                    looks_of(&seen).is_some(),
                    "{NO_LOOKS} without {group}: --loso TEXT chooses the footage that is left out"
                );
            }
        }
        fs::create_dir_all(&args.out).with_context(|| format!("cannot create {}", args.out.display()))?;
        for group in groups {
            let out = args.out.join(format!("{group}.onnx"));
            report.add(train(&args, features, &sources, &|s| s.group == group, &out, &[])?);
        }
    } else {
        let excluded = |s: &LabelledSequence| {
            args.exclude.iter().any(|text| s.group.contains(text.as_str()) || s.name.contains(text.as_str()))
        };
        for text in &args.exclude {
            let matches = |s: &Source| s.labelled.name.contains(text) || s.labelled.group.contains(text);
            ensure!(sources.iter().any(matches), "--exclude {text:?}: no sequence has that in its name");
        }
        // All copies of an excluded sequence go, whatever their names.
        let groups: Vec<String> =
            sources.iter().map(|s| &s.labelled).filter(|s| excluded(s)).map(|s| s.group.clone()).collect();
        let out = args.out.clone();
        report.add(train(&args, features, &sources, &|s| groups.contains(&s.group), &out, &known)?);
    }
    if let Some(path) = &args.plot {
        write(path, curves(&report.epochs)?.as_bytes())?;
    }
    if let Some(path) = &args.report {
        write(path, (serde_json::to_string_pretty(&report)? + "\n").as_bytes())?;
    }
    Ok(())
}

fn load(roots: &[PathBuf]) -> Result<Vec<Source>> {
    let mut sources = vec![];
    for root in roots {
        for folder in dataset::folders(root)? {
            let labelled = dataset::load(&folder)?;
            sources.push(Source { folder, labelled });
        }
    }
    sources.sort_by(|a, b| a.labelled.name.cmp(&b.labelled.name));
    for half in &sources {
        let group = &half.labelled.group;
        let whole =
            group.strip_suffix(['a', 'b']).and_then(|w| sources.iter().find(|s| s.labelled.group == w));
        if let Some(whole) = whole {
            let [half, whole] = [half, whole].map(|s| s.folder.display().to_string());
            bail!(
                "{half} is half of the footage of {whole}: give the halves or the whole, what is held out must not be seen"
            );
        }
    }
    if let Some(pair) = sources.windows(2).find(|w| w[0].labelled.name == w[1].labelled.name) {
        let [a, b] = [&pair[0].folder, &pair[1].folder];
        bail!("sequence {} is given twice: {} and {}", pair[0].labelled.name, a.display(), b.display());
    }
    Ok(sources)
}

/// What `--features` names; where appearance is part of that, the sequences get theirs.
fn features(args: &Args, sources: &mut [Source]) -> Result<Features> {
    let literal = ["literal", "spatial"].contains(&args.features.as_str());
    ensure!(
        args.association != "explicit" || !literal,
        "--association explicit weighs what relative boxes give: --features relative or appearance, not {}",
        args.features
    );
    ensure!(
        !args.simulate_looks || ["appearance", "literal"].contains(&args.features.as_str()),
        "--simulate-looks: --features {} does not look at embeddings; appearance and literal do",
        args.features
    );
    match args.features.as_str() {
        "spatial" => Ok(Features::Literal { embedding: 0 }),
        "literal" => Ok(Features::Literal { embedding: load_embeddings(args, sources)? }),
        "appearance" => Ok(Features::Appearance { embedding: load_embeddings(args, sources)? }),
        _ => Ok(Features::Relative),
    }
}

/// Gives every sequence its embeddings; how wide they are.
fn load_embeddings(args: &Args, sources: &mut [Source]) -> Result<usize> {
    let mut width = None;
    for Source { folder, labelled } in sources {
        if args.simulate_looks && !folder.join(dataset::EMBEDDINGS).is_file() {
            continue;
        }
        dataset::load_embeddings(folder, labelled).with_context(|| {
            let features = &args.features;
            format!("--features {features} needs the appearance of every sequence, or --simulate-looks")
        })?;
        for found in labelled.frames.iter().flat_map(|f| f.embeddings.iter().flatten()) {
            let found = found.as_slice().len();
            let width = *width.get_or_insert(found);
            ensure!(
                found == width,
                "{}: embeddings of {found} numbers, those before it have {width}",
                folder.display()
            );
        }
    }
    width.context("no sequence has a usable embedding")
}

/// The sequences, those without embeddings with simulated ones.
fn dress(seen: &[&Source], seed: u64) -> Result<Vec<Source>> {
    let looks = looks_of(seen).context(NO_LOOKS)?;
    let mut rng = fastrand::Rng::with_seed(seed);
    let mut dressed: Vec<Source> = seen.iter().copied().cloned().collect();
    for Source { labelled, .. } in dressed.iter_mut().filter(|s| !s.labelled.has_embeddings()) {
        looks.dress(labelled, &mut rng);
    }
    Ok(dressed)
}

/// Why looks cannot be simulated.
const NO_LOOKS: &str =
    "--simulate-looks: none of the training sequences has embeddings of two people or more";

/// What can be learned of the looks of people.
fn looks_of(seen: &[&Source]) -> Option<Looks> {
    let known: Vec<&LabelledSequence> =
        seen.iter().map(|s| &s.labelled).filter(|s| s.has_embeddings()).collect();
    Looks::of(&known)
}

/// Width of the hidden state where none is given.
fn hidden(features: Features) -> usize {
    match features {
        // The paper's: a step of 128 + 6 values.
        Features::Literal { .. } => 134,
        _ => Fit::default().hidden,
    }
}

/// Trains one network without the sequences that `held_out` names, writes it and its card, and scores
/// it on them.
fn train(
    args: &Args,
    features: Features,
    sources: &[Source],
    held_out: &dyn Fn(&LabelledSequence) -> bool,
    out: &Path,
    known: &[Unseen],
) -> Result<Trained> {
    let (held, seen): (Vec<&Source>, Vec<&Source>) = sources.iter().partition(|s| held_out(&s.labelled));
    ensure!(!seen.is_empty(), "nothing to train on: every sequence is held out");
    let simulated = args.simulate_looks && seen.iter().any(|s| !s.labelled.has_embeddings());
    let dressed = if simulated { dress(&seen, args.seed)? } else { vec![] };
    let seen = if simulated { dressed.iter().collect() } else { seen };
    let name = out.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let (filter, filter_of) = filter(args, out)?;
    let tracker = TrackerConfig { filter, ..TrackerConfig::default() };
    let teacher = Teacher { filter: tracker.filter, features, ..Teacher::default() };
    let recipe = Recipe { teacher, examples: args.examples as usize, seed: args.seed, ..Recipe::default() };
    let examples = collect(&recipe, &seen, &name);
    ensure!(
        !examples.training.is_empty(),
        "no pair in the training sequences: are there detections that overlap truth?"
    );
    let settings = Fit {
        hidden: args.hidden.map_or(hidden(features), |hidden| hidden as usize),
        epochs: args.epochs as usize,
        seed: args.seed,
        patience: args.patience as usize,
        threads: args.threads.or_else(|| thread::available_parallelism().ok().map(usize::from)).unwrap_or(1),
        ..Fit::default()
    };
    let mut checkpoint = CheckpointFile::open(args, out, &settings, &examples)?;
    let (model, epochs) = run_fit(args.association.parse()?, &settings, &examples, &name, &mut checkpoint);
    let boxes = tracked::boxes(&model, &tracker, &seen, &args.second_half, &name)?;
    ensure!(!boxes.is_empty(), "the tracker confirms no track in the training sequences");
    let head_fit = HeadFit { seed: args.seed, ..HeadFit::default() };
    let head = Arc::new(fit_head(&boxes, &head_fit));

    let mut scores = vec![];
    for source in &held {
        if features.see_appearance() && !source.labelled.has_embeddings() {
            println!("{name} {}: not scored, it has no embeddings", source.labelled.name);
            continue;
        }
        let found = tracked::score(&model, &tracker, &head, source, &args.second_half)?;
        println!(
            "{name} {}: {} pairs, AUC {:.4}, cross-entropy {:.4}, calibration error {:.4}; HOTA {:.2} MOTA {:.2} IDF1 {:.2} IDs {}",
            found.sequence,
            found.pairs,
            found.auc,
            found.loss,
            found.calibration_error,
            found.hota,
            found.mota,
            found.idf1,
            found.id_switches
        );
        scores.push(found);
    }
    let names = |of: &[&Source]| -> Vec<String> { of.iter().map(|s| s.labelled.name.clone()).collect() };
    let mut card = Card {
        file: name,
        bytes: 0,
        licence: args.licence.clone(),
        features,
        explicit: model.association() == Association::Explicit,
        hidden: settings.hidden,
        parameters: model.parameters(),
        sequences: names(&seen),
        excluded: names(&held),
        examples: (examples.training.len(), examples.training.positive_share()),
        boxes: (boxes.len(), boxes.positive_share()),
        settings: describe(&settings, &recipe, (&tracker.filter, filter_of)),
        unseen: known.iter().chain(&scores).cloned().collect(),
    };
    if simulated {
        card.settings.push(("embeddings".into(), "simulated for sequences that have none".into()));
    }
    let mut metadata: BTreeMap<String, String> = card.settings.iter().cloned().collect();
    metadata.insert("licence".into(), args.licence.clone());
    metadata.insert("existence".into(), head.to_string());
    metadata.insert("filter".into(), FilterTuning::of(&tracker.filter).to_toml()?);
    metadata.insert("sequences".into(), card.sequences.join(" "));
    metadata.insert("excluded".into(), card.excluded.join(" "));
    if card.explicit {
        metadata.insert("association".into(), args.association.clone());
    }
    let bytes = model.write("Probability that a detection continues a track", &metadata);
    card.bytes = bytes.len();
    write(out, &bytes)?;
    write(&out.with_extension("md"), card.markdown().as_bytes())?;
    write(&out.with_extension("toml"), manifest(out, &bytes, &args.licence, model.family())?.as_bytes())?;
    checkpoint.remove();
    println!("wrote {} ({} examples)", out.display(), examples.training.len());
    Ok(Trained { name: card.file, epochs, unseen: scores })
}

/// The filter that the network in `out` is for, and what it was tuned on.
fn filter(args: &Args, out: &Path) -> Result<(FilterConfig, String)> {
    let default = FilterConfig::default();
    let Some(file) = &args.tuning else {
        if args.loso.is_some() {
            tracing::warn!("no --tuning: the filter is the program's own, {}", FilterConfig::TUNED_ON);
        }
        return Ok((default, format!("the program's own, {}", FilterConfig::TUNED_ON)));
    };
    let file = match &args.loso {
        Some(_) => file.join(out.with_extension("toml").file_name().unwrap_or_default()),
        None => file.clone(),
    };
    let tuning = Tuning::read(&file)?;
    let data = tuning.origin.map_or_else(|| "unknown data".into(), |origin| origin.data.join(", "));
    Ok((tuning.filter.apply(default), format!("a tuning file, of {data}")))
}

/// A manifest of this one network, so that `--link OUT.onnx` takes it.
fn manifest(out: &Path, bytes: &[u8], licence: &str, family: &str) -> Result<String> {
    #[derive(Serialize)]
    struct Entry<'a> {
        name: &'a str,
        task: &'a str,
        family: &'a str,
        file: &'a str,
        sha256: String,
        license: &'a str,
        source: &'a str,
    }
    let entry = Entry {
        name: out.file_stem().and_then(|n| n.to_str()).unwrap_or("link"),
        task: "link",
        family,
        file: out.file_name().and_then(|n| n.to_str()).unwrap_or("link.onnx"),
        sha256: Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect(),
        license: licence.lines().next().unwrap_or_default(),
        source: "gakp train",
    };
    Ok(toml::to_string(&BTreeMap::from([("model", [entry])]))?)
}

fn collect(recipe: &Recipe, seen: &[&Source], name: &str) -> Split {
    let sequences: Vec<&LabelledSequence> = seen.iter().map(|s| &s.labelled).collect();
    let bar = bar((sequences.len() * recipe.variants.len()) as u64, "{msg} {wide_bar} {pos}/{len}");
    bar.set_message(format!("{name}: examples"));
    let examples = recipe.collect(&sequences, |done, of| {
        bar.set_length(of as u64);
        bar.set_position(done as u64);
    });
    bar.finish_and_clear();
    examples
}

fn run_fit(
    association: Association,
    settings: &Fit,
    examples: &Split,
    name: &str,
    checkpoint: &mut CheckpointFile,
) -> (Network, Vec<Epoch>) {
    let mut mean = f64::NAN;
    let bar = bar(0, "{msg} {wide_bar} {pos}/{len} {eta}");
    let from = checkpoint.found.take();
    let (model, epochs) = Network::fit(association, examples, settings, from, |p| {
        bar.set_length(p.steps as u64);
        mean = if mean.is_nan() { p.loss } else { mean + 0.02 * (p.loss - mean) };
        bar.set_message(format!("{name}: cross-entropy {mean:.4}"));
        bar.set_position(p.step as u64);
        if let Some(state) = p.checkpoint
            && let Err(error) = checkpoint.save(state)
        {
            tracing::warn!("this run cannot be resumed: {error:#}");
        }
    });
    bar.finish_and_clear();
    for (i, Epoch { training, validation }) in epochs.iter().enumerate() {
        let validation = validation.map_or("none".into(), |loss| format!("{loss:.4}"));
        println!("{name}: epoch {}, cross-entropy {training:.4}, on validation pairs {validation}", i + 1);
    }
    (model, epochs)
}

/// A bar on a terminal, nothing elsewhere.
fn bar(length: u64, form: &str) -> ProgressBar {
    let style = ProgressStyle::with_template(form).unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(length).with_style(style)
}

fn describe(
    fit: &Fit,
    recipe: &Recipe,
    (filter, filter_of): (&FilterConfig, String),
) -> Vec<(String, String)> {
    let Recipe { teacher, variants, seed, .. } = recipe;
    let of = |values: [f64; 3]| values.map(|v| v.to_string()).join(" / ");
    let rows = [
        ("filter", filter_of),
        (
            "acceleration / walk / measurement of the centre",
            of([filter.centre_acceleration, filter.centre_walk, filter.centre_measurement]),
        ),
        ("of the size", of([filter.size_acceleration, filter.size_walk, filter.size_measurement])),
        ("seed", seed.to_string()),
        ("epochs", format!("{} at most, the one of least validation loss", fit.epochs)),
        ("validation pairs", format!("{} % of all, the last of every sequence", 100.0 * recipe.validation)),
        ("batch", fit.batch.to_string()),
        ("optimiser", format!("Adam, peak {}, warm-up {}, cosine to 0", fit.rate, fit.warm_up)),
        ("copies of a sequence", variants.len().to_string()),
        ("drop bursts", format!("{} a frame, {} s U^2", teacher.burst_chance, teacher.burst_longest)),
        ("easy positives kept", teacher.keep_easy.to_string()),
        ("far negatives kept", teacher.keep_far.to_string()),
        ("weight", format!("sqrt(min(1 / kept, {}))", teacher.max_weight)),
    ];
    rows.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
}

fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    fs::write(path, bytes).with_context(|| format!("cannot write {}", path.display()))
}
