//! ONNX Runtime: loading the library, choosing the execution provider, the options of a session.

use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use ort::editor::{Graph, Model, Node, ONNX_DOMAIN, Opset};
use ort::environment::Environment;
use ort::ep::{self, ExecutionProviderDispatch};
use ort::session::Session;
use ort::session::builder::{GraphOptimizationLevel, SessionBuilder};
use ort::value::{Outlet, Shape, SymbolicDimensions, TensorElementType, TensorRef, ValueType};

use super::{Arrangement, InferError, Task};

/// What the user asks for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ProviderChoice {
    /// CUDA when it works, else the CPU; the reason is logged. (TensorRT is not tried: it builds its
    /// engines for minutes, which nobody should get without asking.)
    #[default]
    Auto,
    /// The CPU.
    Cpu,
    /// CUDA, or an error.
    Cuda,
    /// TensorRT, with CUDA for what it cannot do, or an error.
    TensorRt,
}

impl std::str::FromStr for ProviderChoice {
    type Err = InferError;

    fn from_str(text: &str) -> Result<Self, InferError> {
        match text {
            "auto" => Ok(Self::Auto),
            "cpu" => Ok(Self::Cpu),
            "cuda" => Ok(Self::Cuda),
            "tensorrt" => Ok(Self::TensorRt),
            _ => Err(InferError::Setting {
                setting: "provider",
                reason: format!("{text:?} is none of auto, cpu, cuda, tensorrt"),
            }),
        }
    }
}

/// What is really used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Provider {
    /// The CPU.
    Cpu,
    /// CUDA.
    Cuda,
    /// TensorRT.
    TensorRt,
}

impl Provider {
    /// The name used in settings, logs and metrics.
    pub fn as_str(self) -> &'static str {
        match self {
            Provider::Cpu => "cpu",
            Provider::Cuda => "cuda",
            Provider::TensorRt => "tensorrt",
        }
    }

    /// The arrangement that suits the provider.
    ///
    /// On the CPU one single-threaded instance a core is fastest (two of one thread 239 frames/s, one
    /// of two threads 180, batches of 4 or 8 201; NanoDet-g INT8 on 2 cores), so nothing waits. A GPU
    /// wants batches; its second worker prepares while the first one's batch runs.
    pub fn arrangement(self, task: Task, threads: Option<usize>) -> Arrangement {
        let cores = thread::available_parallelism().map_or(1, usize::from);
        let threads = threads.unwrap_or(cores).max(1);
        match (self, task) {
            (Provider::Cpu, Task::Detect) => {
                Arrangement { workers: threads, max_batch: 1, max_wait: Duration::ZERO, capacity: 64 }
            }
            (Provider::Cpu, Task::Reid) => {
                Arrangement { workers: threads, max_batch: 1, max_wait: Duration::ZERO, capacity: 256 }
            }
            // A link request costs far less than a frame; one worker in four keeps up.
            (Provider::Cpu, Task::Link) => Arrangement {
                workers: threads.div_ceil(4),
                max_batch: 1,
                max_wait: Duration::ZERO,
                capacity: 256,
            },
            (_, Task::Detect) => {
                Arrangement { workers: 2, max_batch: 16, max_wait: Duration::from_millis(3), capacity: 256 }
            }
            (_, Task::Reid) => {
                Arrangement { workers: 2, max_batch: 64, max_wait: Duration::from_millis(2), capacity: 512 }
            }
            (_, Task::Link) => {
                Arrangement { workers: 1, max_batch: 4096, max_wait: Duration::from_millis(1), capacity: 512 }
            }
        }
    }
}

/// The loaded library and the provider that works on this machine.
#[derive(Clone, Debug)]
pub struct Runtime {
    environment: Environment,
    /// The library's path.
    pub library: PathBuf,
    /// What is really used.
    pub provider: Provider,
    /// Why `auto` did not take a GPU.
    pub fallback: Option<String>,
    engine_cache: PathBuf,
}

/// A process has one environment, whatever is loaded in it.
static LOADED: Mutex<Option<(PathBuf, Environment)>> = Mutex::new(None);

impl Runtime {
    /// Loads ONNX Runtime and finds out which provider works, by running a graph of one node on it.
    ///
    /// The library is the first that there is of: `library` (the setting), `ORT_DYLIB_PATH`,
    /// `cache/libonnxruntime.so` in `models` (the manifest's folder), the system's.
    ///
    /// # Errors
    /// [`InferError::Library`], or [`InferError::Provider`] for a provider that was asked for by name.
    pub fn load(choice: ProviderChoice, library: Option<&Path>, models: &Path) -> Result<Self, InferError> {
        let (library, environment) = environment(library, models)?;
        let mut runtime = Self {
            environment,
            library,
            provider: Provider::Cpu,
            fallback: None,
            engine_cache: models.join("cache").join("tensorrt"),
        };
        match choice {
            ProviderChoice::Cpu => {}
            ProviderChoice::Cuda => runtime.require(Provider::Cuda)?,
            ProviderChoice::TensorRt => runtime.require(Provider::TensorRt)?,
            ProviderChoice::Auto => match runtime.probe(Provider::Cuda) {
                Ok(()) => runtime.provider = Provider::Cuda,
                Err(reason) => {
                    tracing::info!(reason = %reason, "no CUDA here: models run on the CPU");
                    runtime.fallback = Some(reason.to_string());
                }
            },
        }
        Ok(runtime)
    }

    fn require(&mut self, provider: Provider) -> Result<(), InferError> {
        self.probe(provider).map_err(|error| InferError::Provider {
            provider: provider.as_str(),
            reason: error.to_string(),
        })?;
        self.provider = provider;
        Ok(())
    }

    /// Runs `y = Identity(x)`. That a provider can be registered does not show that it works: a
    /// missing driver is noticed when a session is made, a broken one when it runs.
    fn probe(&self, provider: Provider) -> ort::Result<()> {
        let outlet = |name: &str| {
            let shape = Shape::new([1]);
            let dimension_symbols = SymbolicDimensions::empty(1);
            Outlet::new(name, ValueType::Tensor { ty: TensorElementType::Float32, shape, dimension_symbols })
        };
        let mut graph = Graph::new()?;
        graph.set_inputs([outlet("x")])?;
        graph.set_outputs([outlet("y")])?;
        graph.add_node(Node::new("Identity", ONNX_DOMAIN, "probe", ["x"], ["y"], [])?)?;
        let mut model = Model::new([Opset::new(ONNX_DOMAIN, 21)?])?;
        model.set_graph(graph)?;
        let builder = SessionBuilder::new(&self.environment)?
            .with_execution_providers(self.providers(provider, None))?;
        let mut session = model.into_session(&builder)?;
        session.run(ort::inputs![TensorRef::from_array_view(([1usize], &[1f32][..]))?])?;
        Ok(())
    }

    /// The providers to register, each an error if it fails.
    fn providers(&self, provider: Provider, profile: Option<&Profile>) -> Vec<ExecutionProviderDispatch> {
        // Every new shape would otherwise start an exhaustive search for the fastest algorithm.
        let cuda = || {
            ep::CUDA::default()
                .with_conv_algorithm_search(ep::cuda::ConvAlgorithmSearch::Heuristic)
                .build()
                .error_on_failure()
        };
        let tensorrt = || {
            let cache = self.engine_cache.display();
            let mut tensorrt = ep::TensorRT::default()
                .with_fp16(true)
                .with_engine_cache(true)
                .with_engine_cache_path(&cache)
                .with_timing_cache(true)
                .with_timing_cache_path(&cache);
            if let Some(Profile { min, opt, max }) = profile {
                tensorrt = tensorrt
                    .with_profile_min_shapes(min)
                    .with_profile_opt_shapes(opt)
                    .with_profile_max_shapes(max);
            }
            tensorrt.build().error_on_failure()
        };
        match provider {
            Provider::Cpu => vec![],
            Provider::Cuda => vec![cuda()],
            Provider::TensorRt => vec![tensorrt(), cuda()],
        }
    }

    /// Makes a session of `file`, on the provider and nothing less.
    ///
    /// # Errors
    /// [`InferError::Graph`] with ONNX Runtime's words.
    pub(super) fn session(
        &self,
        name: &str,
        file: &Path,
        profile: Option<&Profile>,
    ) -> Result<Session, InferError> {
        let make = || -> ort::Result<Session> {
            SessionBuilder::new(&self.environment)?
                .with_optimization_level(GraphOptimizationLevel::All)?
                // The worker's own thread does the work; a pool beside it would only spin.
                .with_intra_threads(1)?
                .with_inter_threads(1)?
                .with_intra_op_spinning(false)?
                .with_inter_op_spinning(false)?
                .with_execution_providers(self.providers(self.provider, profile))?
                .commit_from_file(file)
        };
        make().map_err(|error| InferError::Graph {
            name: name.into(),
            reason: format!("ONNX Runtime refuses {}: {error}", file.display()),
        })
    }
}

/// The range of shapes that a TensorRT engine is built for, as `input:1x3x288x352`.
#[derive(Clone, Debug)]
pub(super) struct Profile {
    pub min: String,
    pub opt: String,
    pub max: String,
}

/// The process's environment; loads the library the first time.
fn environment(setting: Option<&Path>, models: &Path) -> Result<(PathBuf, Environment), InferError> {
    let mut loaded = LOADED.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some((library, environment)) = &*loaded {
        if setting.is_some_and(|setting| setting != library) {
            tracing::warn!(library = %library.display(), "ONNX Runtime is loaded already; a process has one");
        }
        return Ok((library.clone(), environment.clone()));
    }
    let mut tried = vec![];
    for (origin, path) in candidates(setting, models) {
        // A bare name is left to the dynamic linker.
        let bare = path.components().count() == 1;
        if !bare && !path.exists() {
            tried.push(format!("{} ({origin}): no such file", path.display()));
        } else {
            // ort looks relative paths up beside the executable first.
            let path = if bare { path } else { std::path::absolute(&path).unwrap_or(path) };
            match ort::init_from(&path) {
                Ok(builder) => {
                    let environment =
                        // The library's own telemetry minds its environment variable alone: `main` sets it.
                        builder.with_name("gakp").with_telemetry(false).build().map_err(|error| {
                            InferError::Library { tried: format!("{}: {error}", path.display()) }
                        })?;
                    *loaded = Some((path.clone(), environment.clone()));
                    return Ok((path, environment));
                }
                Err(error) => tried.push(format!("{} ({origin}): {error}", path.display())),
            }
        }
        // What was asked for by name is not silently replaced.
        if origin != "beside the manifest" {
            break;
        }
    }
    Err(InferError::Library { tried: tried.join("; ") })
}

/// Where to look for the library, and who says so.
fn candidates(setting: Option<&Path>, models: &Path) -> Vec<(&'static str, PathBuf)> {
    let mut all = vec![];
    if let Some(path) = setting {
        all.push(("the setting", path.to_path_buf()));
    }
    if let Some(path) = std::env::var_os("ORT_DYLIB_PATH").filter(|path| !path.is_empty()) {
        all.push(("ORT_DYLIB_PATH", path.into()));
    }
    all.push(("beside the manifest", models.join("cache").join("libonnxruntime.so")));
    all.push(("the system's", "libonnxruntime.so".into()));
    all
}
