//! The graph: normalise, encode every track, last step of every pair.

use super::super::model::{CLIP, LinkModel, Normaliser};
use super::proto::{
    AttributeProto, DimensionProto, GraphProto, NodeProto, TensorProto, TensorShapeProto, TensorTypeProto,
    TypeProto, ValueInfoProto, attribute_type, data_type,
};
use crate::track::{Features, HISTORY};

pub(super) const HISTORY_MEAN: &str = "history.mean";
pub(super) const HISTORY_SCALE: &str = "history.scale";
pub(super) const CANDIDATE_MEAN: &str = "candidate.mean";
pub(super) const CANDIDATE_SCALE: &str = "candidate.scale";
pub(super) const GRU_W: &str = "gru.W";
pub(super) const W_CANDIDATE: &str = "candidate.W";
pub(super) const B_CANDIDATE: &str = "candidate.b";
pub(super) const U_RZ: &str = "last.U_rz";
pub(super) const U_C: &str = "last.U_c";
pub(super) const V: &str = "readout.v";
pub(super) const V0: &str = "readout.v0";

/// The graph under construction.
#[derive(Default)]
pub(super) struct Builder {
    graph: GraphProto,
}

impl Builder {
    pub(super) fn new(name: &str) -> Self {
        let mut b = Self::default();
        b.graph.name = Some(name.into());
        b.floats("clip.low", &[], &[-CLIP]);
        b.floats("clip.high", &[], &[CLIP]);
        b
    }

    /// The graph with the inputs and the output that every link network has.
    pub(super) fn finish(mut self, features: Features) -> GraphProto {
        let (t, p) = (Dim::Named("T"), Dim::Named("P"));
        let [float, int32, int64] = [data_type::FLOAT, data_type::INT32, data_type::INT64];
        self.graph.input = vec![
            value(
                "histories",
                float,
                &[t, Dim::Fixed(HISTORY), Dim::Fixed(features.step())],
                "observations of each track, oldest first, packed from index 0",
            ),
            value("lengths", int32, &[Dim::Named("T")], "valid observations of each track, 1 to 6"),
            value("candidates", float, &[p, Dim::Fixed(features.candidate())], "candidate of each pair"),
            value("pair_track", int64, &[Dim::Named("P")], "row of histories of each pair"),
        ];
        self.graph.output =
            vec![value("probability", float, &[Dim::Named("P")], "that the candidate continues the track")];
        self.graph
    }

    pub(super) fn floats(&mut self, name: &str, dims: &[usize], values: &[f32]) {
        assert_eq!(dims.iter().product::<usize>(), values.len(), "{name}: shape {dims:?}");
        let raw = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.tensor(name, dims, data_type::FLOAT, raw);
    }

    pub(super) fn integers(&mut self, name: &str, values: &[i64]) {
        let raw = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.tensor(name, &[values.len()], data_type::INT64, raw);
    }

    fn tensor(&mut self, name: &str, dims: &[usize], data_type: i32, raw: Vec<u8>) {
        self.graph.initializer.push(TensorProto {
            dims: dims.iter().map(|d| *d as i64).collect(),
            data_type: Some(data_type),
            name: Some(name.into()),
            raw_data: Some(raw),
        });
    }

    /// Adds a node named after its first non-empty output.
    pub(super) fn node(
        &mut self,
        op: &str,
        inputs: &[&str],
        outputs: &[&str],
        attribute: Vec<AttributeProto>,
    ) {
        let owned = |names: &[&str]| names.iter().map(|n| (*n).to_owned()).collect();
        self.graph.node.push(NodeProto {
            input: owned(inputs),
            output: owned(outputs),
            name: outputs.iter().find(|n| !n.is_empty()).map(|n| format!("{op}:{n}")),
            op_type: Some(op.into()),
            attribute,
        });
    }

    /// `output = clip((input - mean) * scale)`.
    pub(super) fn normalise(
        &mut self,
        input: &str,
        output: &str,
        prefix: [&str; 2],
        normaliser: &Normaliser,
    ) {
        let width = normaliser.mean.len();
        let [mean, scale] = prefix;
        self.floats(mean, &[width], &normaliser.mean);
        self.floats(scale, &[width], &normaliser.scale);
        let (centred, scaled) = (format!("{output}.centred"), format!("{output}.scaled"));
        self.node("Sub", &[input, mean], &[&centred], vec![]);
        self.node("Mul", &[&centred, scale], &[&scaled], vec![]);
        self.node("Clip", &[&scaled, "clip.low", "clip.high"], &[output], vec![]);
    }

    /// Histories to states: `state`, `[T, H]`, of a GRU with weights `w [S, 3 H]`, `u [H, 3 H]`
    /// and biases `bias [3 H]`, gates r, z, c. Leaves `axis.0` for other squeezes.
    pub(super) fn encode_histories(&mut self, normaliser: &Normaliser, w: &[f32], u: &[f32], bias: &[f32]) {
        let g = bias.len();
        let h = g / 3;
        let width = w.len() / g;
        self.normalise("histories", "histories.z", [HISTORY_MEAN, HISTORY_SCALE], normaliser);
        self.node("Transpose", &["histories.z"], &["steps"], vec![ints("perm", &[1, 0, 2])]);
        self.floats(GRU_W, &[1, g, width], &to_gru_op(w, width, h));
        self.floats("gru.R", &[1, g, h], &to_gru_op(u, h, h));
        let mut biases = to_gru_op(bias, 1, h);
        biases.resize(2 * g, 0.0);
        self.floats("gru.B", &[1, 2 * g], &biases);
        let attributes = vec![int("hidden_size", h as i64), int("linear_before_reset", 0)];
        self.node("GRU", &["steps", GRU_W, "gru.R", "gru.B", "lengths"], &["", "state.1"], attributes);
        self.integers("axis.0", &[0]);
        self.node("Squeeze", &["state.1", "axis.0"], &["state"], vec![]);
    }
}

pub(super) fn int(name: &str, value: i64) -> AttributeProto {
    let r#type = Some(attribute_type::INT);
    AttributeProto { name: Some(name.into()), i: Some(value), ints: vec![], r#type }
}

pub(super) fn ints(name: &str, values: &[i64]) -> AttributeProto {
    let r#type = Some(attribute_type::INTS);
    AttributeProto { name: Some(name.into()), i: None, ints: values.to_vec(), r#type }
}

fn value(name: &str, elem_type: i32, dims: &[Dim], doc: &str) -> ValueInfoProto {
    let dim = dims
        .iter()
        .map(|d| match d {
            Dim::Fixed(n) => DimensionProto { dim_value: Some(*n as i64), dim_param: None },
            Dim::Named(n) => DimensionProto { dim_value: None, dim_param: Some((*n).into()) },
        })
        .collect();
    let tensor_type =
        Some(TensorTypeProto { elem_type: Some(elem_type), shape: Some(TensorShapeProto { dim }) });
    ValueInfoProto {
        name: Some(name.into()),
        r#type: Some(TypeProto { tensor_type }),
        doc_string: Some(doc.into()),
    }
}

enum Dim {
    Fixed(usize),
    Named(&'static str),
}

/// For a column of ONNX's gates z, r, c: the column of ours, r, z, c, and its sign there.
fn ours(column: usize, hidden: usize) -> (usize, f32) {
    match column / hidden {
        0 => (column + hidden, -1.0),
        1 => (column - hidden, 1.0),
        _ => (column, 1.0),
    }
}

/// `[rows, 3 H]` of gates r, z, c to what ONNX's GRU wants: `[3 H, rows]`, gates z, r, c, and z
/// negated, because ONNX's z keeps the old state where the paper's takes the new one and
/// `1 - sigmoid(a) = sigmoid(-a)`.
fn to_gru_op(weights: &[f32], rows: usize, hidden: usize) -> Vec<f32> {
    let gates = 3 * hidden;
    (0..gates)
        .flat_map(|column| {
            let (ours, sign) = ours(column, hidden);
            (0..rows).map(move |row| sign * weights[row * gates + ours])
        })
        .collect()
}

/// The inverse of [`to_gru_op`].
pub(super) fn from_gru_op(weights: &[f32], rows: usize, hidden: usize) -> Vec<f32> {
    let gates = 3 * hidden;
    let mut found = vec![0.0; rows * gates];
    for column in 0..gates {
        let (ours, sign) = ours(column, hidden);
        for row in 0..rows {
            found[row * gates + ours] = sign * weights[column * rows + row];
        }
    }
    found
}

/// The graph of `model`.
pub(super) fn build(model: &LinkModel) -> GraphProto {
    let gru = &model.gru;
    let (shape, h, g) = (gru.shape, gru.shape.hidden, 3 * gru.shape.hidden);
    let mut b = Builder::new("gakp-link");

    let u = gru.part(shape.u());
    b.encode_histories(&model.history, gru.part(shape.w_history()), u, gru.part(shape.b()));

    // What the state adds to r and z of the last step, once a track; then by pair.
    let rows = || u.chunks_exact(g);
    b.floats(U_RZ, &[h, 2 * h], &rows().flat_map(|r| r[..2 * h].to_vec()).collect::<Vec<_>>());
    b.node("MatMul", &["state", U_RZ], &["state.rz"], vec![]);
    b.node("Gather", &["state", "pair_track"], &["pair.state"], vec![int("axis", 0)]);
    b.node("Gather", &["state.rz", "pair_track"], &["pair.state.rz"], vec![int("axis", 0)]);

    // Candidates to gates, [P, 3 H].
    b.normalise("candidates", "candidates.z", [CANDIDATE_MEAN, CANDIDATE_SCALE], &model.candidate);
    b.floats(W_CANDIDATE, &[shape.features.candidate(), g], gru.part(shape.w_candidate()));
    b.floats(B_CANDIDATE, &[g], gru.part(shape.b()));
    b.node("Gemm", &["candidates.z", W_CANDIDATE, B_CANDIDATE], &["candidate.gates"], vec![]);
    b.integers("split.rz_c", &[2 * h as i64, h as i64]);
    b.node(
        "Split",
        &["candidate.gates", "split.rz_c"],
        &["candidate.rz", "candidate.c"],
        vec![int("axis", 1)],
    );

    // The last step: Eq. GRU, the reset gate before the product.
    b.node("Add", &["candidate.rz", "pair.state.rz"], &["rz.pre"], vec![]);
    b.node("Sigmoid", &["rz.pre"], &["rz"], vec![]);
    b.integers("split.r_z", &[h as i64, h as i64]);
    b.node("Split", &["rz", "split.r_z"], &["r", "z"], vec![int("axis", 1)]);
    b.node("Mul", &["r", "pair.state"], &["reset"], vec![]);
    b.floats(U_C, &[h, h], &rows().flat_map(|r| r[2 * h..].to_vec()).collect::<Vec<_>>());
    b.node("MatMul", &["reset", U_C], &["reset.c"], vec![]);
    b.node("Add", &["candidate.c", "reset.c"], &["c.pre"], vec![]);
    b.node("Tanh", &["c.pre"], &["c"], vec![]);
    b.node("Sub", &["c", "pair.state"], &["change"], vec![]);
    b.node("Mul", &["z", "change"], &["change.z"], vec![]);
    b.node("Add", &["pair.state", "change.z"], &["last"], vec![]);

    b.floats(V, &[h, 1], gru.part(shape.v()));
    b.floats(V0, &[1], &[gru.theta[shape.v0()]]);
    b.node("Gemm", &["last", V, V0], &["logit.1"], vec![]);
    b.integers("axis.1", &[1]);
    b.node("Squeeze", &["logit.1", "axis.1"], &["logit"], vec![]);
    b.node("Sigmoid", &["logit"], &["probability"], vec![]);

    b.finish(shape.features)
}
