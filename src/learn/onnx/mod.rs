//! A link model as an ONNX file, and back.
//!
//! The file's contract, `T` tracks and `P` pairs of one call, both at least 1:
//!
//! | | name | type |
//! | --- | --- | --- |
//! | in | `histories` | f32 `[T, 6, S]`, observations packed from index 0, oldest first |
//! | in | `lengths` | i32 `[T]`, valid observations, 1 to 6 |
//! | in | `candidates` | f32 `[P, C]` |
//! | in | `pair_track` | i64 `[P]`, row of `histories` |
//! | out | `probability` | f32 `[P]` |
//!
//! S and C are the widths of the model's [`Features`], which the metadata names (`features`; those of
//! [`Features::Relative`], 14 and 20, without). They are raw: normalisation is part of the graph. Each track's history is encoded once and
//! its contribution to the last step's gates is computed once, then gathered by pair.

mod explicit;
mod graph;
pub mod proto;

use std::collections::BTreeMap;

use prost::Message;

use super::explicit::ExplicitModel;
use super::gru::{Gru, GruShape};
use super::model::{LinkModel, Normaliser};
use crate::track::Features;
use crate::track::features::UnknownFeatures;
use proto::{GraphProto, ModelProto, OperatorSetIdProto, StringStringEntryProto, TensorProto, data_type};

/// ONNX intermediate representation and operator set that files are written for (ONNX 1.16).
const IR_VERSION: i64 = 10;
const OPSET: i64 = 21;
/// Metadata that names the features, where they are not the default ones.
const FEATURES: &str = "features";

/// Why a file is no link model.
#[derive(Debug, thiserror::Error)]
pub enum OnnxError {
    /// Not the wire format of an ONNX model.
    #[error("not an ONNX model: {0}")]
    Decode(#[from] prost::DecodeError),
    /// A valid ONNX model, but not one that `gakp train` wrote.
    #[error("not a link model written by `gakp train`: tensor {tensor:?} {problem}")]
    Tensor {
        /// The tensor's name.
        tensor: &'static str,
        /// What is wrong with it.
        problem: String,
    },
    /// Features that this program does not know.
    #[error(transparent)]
    Features(#[from] UnknownFeatures),
}

/// The bytes of an ONNX file of `model`. `metadata` goes into the file's metadata properties, in
/// the order of the keys; what describes the sizes is added.
pub fn write(model: &LinkModel, doc: &str, metadata: &BTreeMap<String, String>) -> Vec<u8> {
    file(graph::build(model), (model.features(), model.gru.shape.hidden), doc, metadata)
}

/// [`write()`] for a network of explicit features. The graph's inputs and output are the same.
pub fn write_explicit(model: &ExplicitModel, doc: &str, metadata: &BTreeMap<String, String>) -> Vec<u8> {
    file(explicit::build(model), (model.shape.features, model.shape.hidden), doc, metadata)
}

fn file(
    graph: GraphProto,
    (features, hidden): (Features, usize),
    doc: &str,
    metadata: &BTreeMap<String, String>,
) -> Vec<u8> {
    let mut metadata = metadata.clone();
    if features != Features::default() {
        metadata.insert(FEATURES.into(), features.to_string());
    }
    metadata.insert("hidden".into(), hidden.to_string());
    let properties = metadata
        .into_iter()
        .map(|(key, value)| StringStringEntryProto { key: Some(key), value: Some(value) })
        .collect();
    ModelProto {
        ir_version: Some(IR_VERSION),
        opset_import: vec![OperatorSetIdProto { domain: Some(String::new()), version: Some(OPSET) }],
        producer_name: Some("gakp train".into()),
        producer_version: Some(env!("CARGO_PKG_VERSION").into()),
        doc_string: Some(doc.into()),
        graph: Some(graph),
        metadata_props: properties,
    }
    .encode_to_vec()
}

/// The model and the metadata of a file that [`write()`] made.
pub fn read(bytes: &[u8]) -> Result<(LinkModel, BTreeMap<String, String>), OnnxError> {
    let file = ModelProto::decode(bytes)?;
    let pair = |p: StringStringEntryProto| Some((p.key?, p.value?));
    let metadata: BTreeMap<String, String> = file.metadata_props.into_iter().filter_map(pair).collect();
    let features: Features = metadata.get(FEATURES).map(|t| t.parse()).transpose()?.unwrap_or_default();
    let [step, candidate] = [features.step(), features.candidate()];
    let tensors = file.graph.map(|g| g.initializer).unwrap_or_default();
    let v = floats(&tensors, graph::V, None)?;
    let shape = GruShape { features, hidden: v.len() };
    let (h, g) = (shape.hidden, 3 * shape.hidden);
    let mut theta = vec![0.0; shape.parameters()];
    let w = graph::from_gru_op(&floats(&tensors, graph::GRU_W, Some(g * step))?, step, h);
    theta[shape.w_history()].copy_from_slice(&w);
    let w = floats(&tensors, graph::W_CANDIDATE, Some(candidate * g))?;
    theta[shape.w_candidate()].copy_from_slice(&w);
    let u_rz = floats(&tensors, graph::U_RZ, Some(2 * h * h))?;
    let u_c = floats(&tensors, graph::U_C, Some(h * h))?;
    for (row, (rz, c)) in
        theta[shape.u()].chunks_exact_mut(g).zip(u_rz.chunks_exact(2 * h).zip(u_c.chunks_exact(h)))
    {
        row[..2 * h].copy_from_slice(rz);
        row[2 * h..].copy_from_slice(c);
    }
    theta[shape.b()].copy_from_slice(&floats(&tensors, graph::B_CANDIDATE, Some(g))?);
    theta[shape.v()].copy_from_slice(&v);
    theta[shape.v0()] = floats(&tensors, graph::V0, Some(1))?[0];
    let model = LinkModel {
        history: Normaliser {
            mean: floats(&tensors, graph::HISTORY_MEAN, Some(step))?,
            scale: floats(&tensors, graph::HISTORY_SCALE, Some(step))?,
        },
        candidate: Normaliser {
            mean: floats(&tensors, graph::CANDIDATE_MEAN, Some(candidate))?,
            scale: floats(&tensors, graph::CANDIDATE_SCALE, Some(candidate))?,
        },
        gru: Gru { shape, theta },
    };
    Ok((model, metadata))
}

/// The values of a float tensor, `length` of them where given, at least one.
fn floats(tensors: &[TensorProto], name: &'static str, length: Option<usize>) -> Result<Vec<f32>, OnnxError> {
    let wrong = |problem: String| OnnxError::Tensor { tensor: name, problem };
    let tensor =
        tensors.iter().find(|t| t.name.as_deref() == Some(name)).ok_or_else(|| wrong("is missing".into()))?;
    if tensor.data_type != Some(data_type::FLOAT) {
        return Err(wrong(format!("has data type {:?}, not float", tensor.data_type)));
    }
    let raw = tensor.raw_data.as_deref().unwrap_or_default();
    if raw.is_empty() || raw.len() % 4 != 0 || length.is_some_and(|n| raw.len() != 4 * n) {
        return Err(wrong(format!("has {} bytes, expected 4 x {length:?}", raw.len())));
    }
    Ok(raw.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect())
}
