//! The graph of explicit features: weights of every track, weighted costs of every pair.

use super::super::explicit::ExplicitModel;
use super::graph::{Builder, int};
use super::proto::GraphProto;
use crate::track::association::explicit::{COST_LIMITS, LEAST_DT};
use crate::track::features::{appearance, relative};

/// The graph of `model`; inputs and output are those of the implicit network.
pub(super) fn build(model: &ExplicitModel) -> GraphProto {
    let shape = model.shape;
    let (h, costs) = (shape.hidden, shape.costs());
    let part = |range: std::ops::Range<usize>| &model.theta[range];
    let mut b = Builder::new("gakp-explicit");

    // Histories to weights, [T, K].
    b.encode_histories(&model.history, part(shape.w()), part(shape.u()), part(shape.b()));
    b.floats("weights.V", &[h, costs], part(shape.v()));
    b.floats("weights.v", &[costs], part(shape.v0()));
    b.node("Gemm", &["state", "weights.V", "weights.v"], &["weights.raw"], vec![]);
    b.node("Softplus", &["weights.raw"], &["weights"], vec![]);
    b.node("Gather", &["weights", "pair_track"], &["pair.weights"], vec![int("axis", 0)]);

    // Candidates to squared features, [P, K].
    let column = |b: &mut Builder, name: &str, columns: &[i64]| {
        let index = format!("{name}.columns");
        b.integers(&index, columns);
        b.node("Gather", &["candidates", &index], &[name], vec![int("axis", 1)]);
    };
    column(&mut b, "mahalanobis", &[relative::MAHALANOBIS as i64]);
    column(&mut b, "iou", &[relative::IOU as i64]);
    let first = relative::INNOVATION as i64;
    column(&mut b, "innovation", &[first, first + 1]);
    column(&mut b, "dt", &[relative::DT as i64]);
    b.floats("unit", &[1], &[relative::MAHALANOBIS_UNIT as f32]);
    b.floats("one", &[1], &[1.0]);
    b.floats("dt.least", &[1], &[LEAST_DT]);
    b.integers("axis.1", &[1]);
    b.node("Mul", &["mahalanobis", "unit"], &["distance"], vec![]);
    b.node("Mul", &["distance", "distance"], &["distance2"], vec![]);
    b.node("Sub", &["one", "iou"], &["apart"], vec![]);
    b.node("Mul", &["apart", "apart"], &["apart2"], vec![]);
    b.node("Mul", &["innovation", "innovation"], &["innovation2"], vec![]);
    b.node("ReduceSum", &["innovation2", "axis.1"], &["moved2"], vec![int("keepdims", 1)]);
    b.node("Max", &["dt", "dt.least"], &["dt.safe"], vec![]);
    b.node("Mul", &["dt.safe", "dt.safe"], &["dt2"], vec![]);
    b.node("Div", &["moved2", "dt2"], &["velocity2"], vec![]);
    b.node("Div", &["velocity2", "dt2"], &["acceleration2"], vec![]);
    let mut parts = vec!["distance2", "apart2", "velocity2", "acceleration2"];
    if shape.features.see_appearance() {
        column(&mut b, "cosine", &[appearance::MEAN_COSINE as i64]);
        column(&mut b, "known", &[appearance::KNOWN as i64]);
        b.floats("two", &[1], &[2.0]);
        b.floats("zero", &[1], &[0.0]);
        b.node("Sub", &["one", "cosine"], &["unlike.half"], vec![]);
        b.node("Mul", &["unlike.half", "two"], &["unlike.known"], vec![]);
        b.node("Mul", &["unlike.known", "known"], &["unlike.raw"], vec![]);
        b.node("Max", &["unlike.raw", "zero"], &["unlike"], vec![]);
        parts.push("unlike");
    }
    b.node("Concat", &parts, &["costs.raw"], vec![int("axis", 1)]);
    b.floats("costs.limits", &[costs], &COST_LIMITS[..costs]);
    b.floats("costs.scale", &[costs], &model.scale[..costs]);
    b.node("Min", &["costs.raw", "costs.limits"], &["costs.cut"], vec![]);
    b.node("Mul", &["costs.cut", "costs.scale"], &["costs"], vec![]);

    b.node("Mul", &["costs", "pair.weights"], &["costs.weighted"], vec![]);
    b.node("ReduceSum", &["costs.weighted", "axis.1"], &["cost"], vec![int("keepdims", 0)]);
    b.floats("bias", &[1], &[model.theta[shape.bias()]]);
    b.node("Sub", &["bias", "cost"], &["logit"], vec![]);
    b.node("Sigmoid", &["logit"], &["probability"], vec![]);
    b.finish(shape.features)
}
