//! A session with one float input and one float output, checked against its manifest entry.

use std::path::Path;
use std::time::{Duration, Instant};

use ort::session::Session;
use ort::value::{Outlet, TensorElementType, TensorRef};

use super::manifest::{Dim, ModelEntry};
use super::runtime::{Profile, Runtime};
use super::{Arrangement, InferError, Provider};

/// A model that takes pictures and gives one tensor.
pub(crate) struct PictureGraph {
    session: Session,
    model: &'static str,
    input: String,
    output: String,
    last: Duration,
}

impl PictureGraph {
    /// Loads `file` and checks names, types and shapes.
    ///
    /// # Errors
    /// [`InferError::Graph`] says what the manifest declares and what the file has.
    pub(crate) fn load(
        runtime: &Runtime,
        entry: &ModelEntry,
        file: &Path,
        arrangement: Arrangement,
        (width, height): (usize, usize),
    ) -> Result<Self, InferError> {
        let wrong = |reason: String| InferError::Graph { name: entry.name.clone(), reason };
        let (Some(input), Some(output)) = (&entry.input, &entry.output) else {
            return Err(wrong("the manifest gives it no input or output".into()));
        };
        let most = input.shape[0].fixed().unwrap_or(arrangement.max_batch);
        let shape = |batch| format!("{}:{batch}x3x{height}x{width}", input.name);
        let profile = Profile { min: shape(most.min(1)), opt: shape(most), max: shape(most) };
        let profile = (runtime.provider == Provider::TensorRt).then_some(&profile);
        let session = runtime.session(&entry.name, file, profile)?;
        if session.inputs().len() != 1 {
            return Err(wrong(format!("it has the inputs {}, one is expected", names(session.inputs()))));
        }
        check_outlet("input", &input.name, &input.shape, session.inputs()).map_err(wrong)?;
        check_outlet("output", &output.name, &output.shape, session.outputs()).map_err(wrong)?;
        Ok(Self {
            session,
            model: entry.task.as_str(),
            input: input.name.clone(),
            output: output.name.clone(),
            last: Duration::ZERO,
        })
    }

    /// Runs `[n, 3, height, width]` and hands the output's shape and values to `read`.
    pub(crate) fn run<R>(
        &mut self,
        shape: [usize; 4],
        values: &[f32],
        read: impl FnOnce(&[i64], &[f32]) -> Result<R, String>,
    ) -> Result<R, InferError> {
        let model = self.model;
        let failed = |reason: String| InferError::Run { model, reason };
        let start = Instant::now();
        let tensor = TensorRef::from_array_view((shape, values)).map_err(|e| failed(e.to_string()))?;
        let outputs = self
            .session
            .run(ort::inputs![self.input.as_str() => tensor])
            .map_err(|e| failed(e.to_string()))?;
        self.last += start.elapsed();
        let output =
            outputs.get(&self.output).ok_or_else(|| failed(format!("no output {:?}", self.output)))?;
        let (shape, values) = output.try_extract_tensor::<f32>().map_err(|e| failed(e.to_string()))?;
        read(shape, values).map_err(failed)
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
