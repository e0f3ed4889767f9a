//! A session with one float input and one float output, checked against its manifest entry.
//!
//! Pictures are written into the very memory that ONNX Runtime reads (I/O binding): on the CPU nothing is copied, and a
//! GPU fetches from and writes to page-locked memory by itself. A GPU chooses its kernels anew and grows its memory for
//! every shape, so there a batch is filled up to the next of a few sizes, which are all run before anybody waits.

use std::iter::successors;
use std::path::Path;
use std::time::{Duration, Instant};

use ort::memory::{AllocationDevice, Allocator, AllocatorType, MemoryInfo, MemoryType};
use ort::session::{IoBinding, Session};
use ort::value::{Outlet, Tensor, TensorElementType};

use super::manifest::{Dim, ModelEntry};
use super::runtime::{Profile, Runtime};
use super::{InferError, Provider};

/// Shapes of the input that are kept: pictures of many forms, batches of several sizes.
const SHAPES: usize = 16;

/// A model that takes pictures and gives one tensor.
pub(crate) struct PictureGraph {
    session: Session,
    model: &'static str,
    input: String,
    output: String,
    batch: Batch,
    memory: Memory,
    /// The one that was used last is the last.
    bound: Vec<Bound>,
    last: Duration,
}

/// How many pictures one call holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Batch {
    /// The file's own number.
    Fixed(usize),
    /// As many as there are: a CPU takes any shape as it comes.
    Any(usize),
    /// The next power of two, at most this.
    Steps(usize),
}

impl Batch {
    fn most(self) -> usize {
        match self {
            Batch::Fixed(most) | Batch::Any(most) | Batch::Steps(most) => most,
        }
    }

    /// Of a call with so many pictures.
    fn of(self, pictures: usize) -> usize {
        match self {
            Batch::Fixed(batch) => batch,
            Batch::Any(_) => pictures,
            Batch::Steps(most) => pictures.next_power_of_two().min(most),
        }
    }

    /// Those that are run before anybody waits.
    fn warm_ups(self) -> Vec<usize> {
        match self {
            Batch::Fixed(batch) => vec![batch],
            Batch::Any(_) => vec![1],
            Batch::Steps(most) => successors(Some(1), |n| (*n < most).then(|| (2 * n).min(most))).collect(),
        }
    }
}

/// Where tensors lie: memory that the provider reads and writes without a copy in between.
struct Memory {
    input: Allocator,
    output: MemoryInfo<'static>,
}

impl Memory {
    fn of(provider: Provider, session: &Session) -> ort::Result<Self> {
        if provider == Provider::Cpu {
            return Ok(Self { input: Allocator::default(), output: MemoryInfo::default() });
        }
        let pinned = |kind| MemoryInfo::new(AllocationDevice::CUDA_PINNED, 0, AllocatorType::Device, kind);
        let input = Allocator::new(session, pinned(MemoryType::CPUInput)?)?;
        Ok(Self { input, output: pinned(MemoryType::CPUOutput)? })
    }
}

/// An input of one shape `[batch, 3, height, width]`, and where the output goes.
struct Bound {
    shape: [usize; 4],
    input: Tensor<f32>,
    binding: IoBinding,
}

impl PictureGraph {
    /// Loads `file` and checks names, types and shapes. A call takes at most `most` pictures, unless the file says how
    /// many.
    ///
    /// # Errors
    /// [`InferError::Graph`] says what the manifest declares and what the file has.
    pub(crate) fn load(
        runtime: &Runtime,
        entry: &ModelEntry,
        file: &Path,
        most: usize,
        (width, height): (usize, usize),
    ) -> Result<Self, InferError> {
        let wrong = |reason: String| InferError::Graph { name: entry.name.clone(), reason };
        let (Some(input), Some(output)) = (&entry.input, &entry.output) else {
            return Err(wrong("the manifest gives it no input or output".into()));
        };
        let batch = match input.shape[0].fixed() {
            Some(batch) => Batch::Fixed(batch.max(1)),
            None if runtime.provider == Provider::Cpu => Batch::Any(most.max(1)),
            None => Batch::Steps(most.max(1)),
        };
        let most = batch.most();
        let shape = |batch| format!("{}:{batch}x3x{height}x{width}", input.name);
        let least = if matches!(batch, Batch::Fixed(_)) { most } else { 1 };
        let profile = Profile { min: shape(least), opt: shape(most), max: shape(most) };
        let profile = (runtime.provider == Provider::TensorRt).then_some(&profile);
        let session = runtime.session(&entry.name, file, profile)?;
        if session.inputs().len() != 1 {
            return Err(wrong(format!("it has the inputs {}, one is expected", names(session.inputs()))));
        }
        check_outlet("input", &input.name, &input.shape, session.inputs()).map_err(wrong)?;
        check_outlet("output", &output.name, &output.shape, session.outputs()).map_err(wrong)?;
        let memory = Memory::of(runtime.provider, &session);
        let memory = memory.map_err(|e| wrong(format!("no memory for its tensors: {e}")))?;
        Ok(Self {
            session,
            model: entry.task.as_str(),
            input: input.name.clone(),
            output: output.name.clone(),
            batch,
            memory,
            bound: vec![],
            last: Duration::ZERO,
        })
    }

    /// Pictures that one call holds at most.
    pub(crate) fn most(&self) -> usize {
        self.batch.most()
    }

    /// Runs every size of a batch that there will be once, `width` x `height` pixels.
    pub(crate) fn warm_up(&mut self, (width, height): (usize, usize)) -> Result<(), InferError> {
        for batch in self.batch.warm_ups() {
            self.input(batch, (width, height))?;
            self.run(|_, _| Ok(()))?;
        }
        Ok(())
    }

    /// The input of the next [`PictureGraph::run`], one `[3, height, width]` behind the other, for `pictures` pictures at
    /// least; more than that are the rest of a batch. What was written into it before is still there.
    ///
    /// # Errors
    /// No memory.
    pub(crate) fn input(
        &mut self,
        pictures: usize,
        (width, height): (usize, usize),
    ) -> Result<&mut [f32], InferError> {
        let shape = [self.batch.of(pictures), 3, height, width];
        let model = self.model;
        let failed = |error: ort::Error| InferError::Run { model, reason: error.to_string() };
        let bound = match self.bound.iter().position(|bound| bound.shape == shape) {
            Some(at) => self.bound.remove(at),
            None => {
                if self.bound.len() == SHAPES {
                    self.bound.remove(0);
                }
                self.bind(shape).map_err(failed)?
            }
        };
        self.bound.push(bound);
        let bound = self.bound.last_mut().expect("just pushed");
        Ok(bound.input.try_extract_tensor_mut::<f32>().map_err(failed)?.1)
    }

    fn bind(&self, shape: [usize; 4]) -> ort::Result<Bound> {
        let mut input = Tensor::<f32>::new(&self.memory.input, shape)?;
        input.try_extract_tensor_mut::<f32>()?.1.fill(0.0);
        let mut binding = self.session.create_binding()?;
        binding.bind_output_to_device(&self.output, &self.memory.output)?;
        Ok(Bound { shape, input, binding })
    }

    /// Runs what lies in the input and hands the output's shape, whose first axis is the batch, and its values to `read`.
    ///
    /// # Errors
    /// ONNX Runtime's, an output of another batch, or what `read` says.
    ///
    /// # Panics
    /// When [`PictureGraph::input`] was never called.
    pub(crate) fn run<R>(
        &mut self,
        read: impl FnOnce(&[i64], &[f32]) -> Result<R, String>,
    ) -> Result<R, InferError> {
        let model = self.model;
        let failed = |reason: String| InferError::Run { model, reason };
        let Bound { shape, input, binding } = self.bound.last_mut().expect("an input");
        let start = Instant::now();
        // A GPU fetches it now.
        binding.bind_input(&self.input, input).map_err(|e| failed(e.to_string()))?;
        let outputs = self.session.run_binding(binding).map_err(|e| failed(e.to_string()))?;
        self.last += start.elapsed();
        let output =
            outputs.get(&self.output).ok_or_else(|| failed(format!("no output {:?}", self.output)))?;
        let (axes, values) = output.try_extract_tensor::<f32>().map_err(|e| failed(e.to_string()))?;
        if axes.first() != Some(&(shape[0] as i64)) {
            return Err(failed(format!("the output has the shape {axes:?} for a batch of {}", shape[0])));
        }
        read(axes, values).map_err(failed)
    }

    /// The time inside ONNX Runtime since the last call of this.
    pub(crate) fn take_time(&mut self) -> Duration {
        std::mem::take(&mut self.last)
    }
}

fn names(outlets: &[Outlet]) -> String {
    outlets.iter().map(Outlet::name).collect::<Vec<_>>().join(", ")
}

/// Compares a declared tensor with the graph's.
fn check_outlet(what: &str, name: &str, declared: &[Dim], outlets: &[Outlet]) -> Result<(), String> {
    let Some(outlet) = outlets.iter().find(|outlet| outlet.name() == name) else {
        return Err(format!("the manifest names the {what} {name:?}, the file has {}", names(outlets)));
    };
    check_type(what, outlet, TensorElementType::Float32)?;
    let found = outlet.dtype().tensor_shape().map(|shape| &shape[..]).unwrap_or_default();
    let fits = found.len() == declared.len()
        && declared.iter().zip(found).all(|(declared, &found)| match declared.fixed() {
            Some(size) => found < 0 || found as usize == size,
            None => found < 0,
        });
    if fits {
        return Ok(());
    }
    let show = |fixed: Option<i64>| fixed.map_or("any".into(), |size| size.to_string());
    let declared: Vec<String> = declared.iter().map(|d| show(d.fixed().map(|size| size as i64))).collect();
    let found: Vec<String> = found.iter().map(|&size| show((size >= 0).then_some(size))).collect();
    Err(format!(
        "the manifest gives {what} {name:?} the shape [{}], the file has [{}]",
        declared.join(", "),
        found.join(", ")
    ))
}

/// Checks an element type.
pub(super) fn check_type(what: &str, outlet: &Outlet, expected: TensorElementType) -> Result<(), String> {
    match outlet.dtype().tensor_type() {
        Some(found) if found == expected => Ok(()),
        found => {
            let found = found.map_or("no tensor".into(), |found| format!("{found:?}"));
            Err(format!("{what} {:?} is {found}, {expected:?} is expected", outlet.name()))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn batches_are_filled_up_to_sizes_that_were_warmed_up() {
        for most in [1, 2, 16, 24, 64] {
            let warm = Batch::Steps(most).warm_ups();
            assert!(warm.is_sorted() && warm[0] == 1 && warm[warm.len() - 1] == most, "{warm:?}");
            for pictures in 1..=most {
                let batch = Batch::Steps(most).of(pictures);
                assert!(
                    batch >= pictures && warm.contains(&batch),
                    "{pictures} of {most}: {batch}, {warm:?}"
                );
            }
        }
        assert_eq!(Batch::Any(16).of(5), 5);
        assert_eq!(Batch::Fixed(4).of(3), 4);
    }
}
