//! Arguments about models, shared by the commands that run them.

#[cfg(all(feature = "service", feature = "testcam"))]
use std::ffi::OsString;
use std::path::PathBuf;

use crate::infer::ModelConfig;

/// Models and where they run.
#[derive(Clone, Debug, Default, clap::Args)]
#[command(next_help_heading = "Models")]
pub struct ModelArgs {
    /// Manifest of models, or its folder.
    #[arg(long, env = "GAKP_MODELS", value_name = "PATH")]
    models: Option<PathBuf>,
    /// Detector: auto, a name in the manifest, or your own as own.toml#name.
    #[arg(long, value_name = "NAME")]
    detector: Option<String>,
    /// Largest detector input, WIDTHxHEIGHT.
    #[arg(long, value_name = "WxH", value_parser = size)]
    detector_size: Option<(usize, usize)>,
    /// Least score of a detection, 0 to 1.
    #[arg(long, value_name = "SCORE")]
    score_threshold: Option<f64>,
    /// Classes to track, by the manifest's names.
    #[arg(long, value_name = "NAME", value_delimiter = ',')]
    classes: Option<Vec<String>>,
    /// ReID: builtin, none, a name in the manifest, or your own.
    #[arg(long, value_name = "NAME")]
    reid: Option<String>,
    /// Link scorer: a name in the manifest, or your own.
    #[arg(long, value_name = "NAME")]
    link: Option<String>,
    /// Execution provider: auto, cpu, cuda, tensorrt.
    #[arg(long, value_name = "NAME")]
    provider: Option<String>,
    /// CPU cores for models.
    #[arg(long, value_name = "N")]
    threads: Option<usize>,
    /// ONNX Runtime's library.
    #[arg(long, value_name = "FILE")]
    onnxruntime: Option<PathBuf>,
}

impl From<ModelArgs> for ModelConfig {
    fn from(args: ModelArgs) -> Self {
        Self {
            manifest: args.models,
            detector: args.detector,
            detector_size: args.detector_size,
            score_threshold: args.score_threshold,
            classes: args.classes,
            reid: args.reid,
            link: args.link,
            provider: args.provider,
            threads: args.threads,
            onnxruntime: args.onnxruntime,
        }
    }
}

impl ModelArgs {
    /// As they are written, for another process.
    #[cfg(all(feature = "service", feature = "testcam"))]
    pub fn to_args(&self) -> Vec<OsString> {
        let path = |path: &Option<PathBuf>| path.clone().map(OsString::from);
        let text = |text: &Option<String>| text.clone().map(OsString::from);
        let number = |number: Option<String>| number.map(OsString::from);
        let given = [
            ("--models", path(&self.models)),
            ("--detector", text(&self.detector)),
            ("--detector-size", number(self.detector_size.map(|(w, h)| format!("{w}x{h}")))),
            ("--score-threshold", number(self.score_threshold.map(|score| score.to_string()))),
            ("--classes", number(self.classes.as_ref().map(|classes| classes.join(",")))),
            ("--reid", text(&self.reid)),
            ("--link", text(&self.link)),
            ("--provider", text(&self.provider)),
            ("--threads", number(self.threads.map(|threads| threads.to_string()))),
            ("--onnxruntime", path(&self.onnxruntime)),
        ];
        let both = given.into_iter().filter_map(|(flag, value)| Some([flag.into(), value?]));
        both.flatten().collect()
    }
}

pub fn size(text: &str) -> Result<(usize, usize), String> {
    let parsed = text.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    parsed.ok_or_else(|| format!("{text:?} is no size: write WIDTHxHEIGHT, such as 352x288"))
}
