//! MOTChallenge: its files as text, and its figures (HOTA, CLEAR MOT, identity) as TrackEval 1.3.0
//! computes them for `MotChallenge2DBox`.
//!
//! ```text
//! gt.txt, SEQ.txt -> rows -> preprocess -> hota, clear, identity -> score, per sequence and combined
//!        rows                                                       score
//! ```
//!
//! Pure: text and numbers in, text and numbers out. `cli` reads and writes the files.

mod clear;
mod embeddings;
mod hota;
mod identity;
mod matching;
mod matrix;
mod npy;
mod preprocess;
mod replay;
mod rows;
mod score;
mod seqinfo;
mod sequence;

pub use clear::Clear;
pub use embeddings::{FeatureError, SequenceEmbeddings};
pub use hota::{ALPHAS, Hota};
pub use identity::Identity;
pub use npy::{Matrix, NpyError, parse_npy, write_npy};
pub use preprocess::{Benchmark, EvalError};
pub use replay::{replay, report_rows, result_rows};
pub use rows::{
    Row, RowError, RowProblem, parse_detections, parse_results, parse_truth, write_detections, write_results,
    write_truth,
};
pub use score::{Score, evaluate};
pub use seqinfo::{SeqInfoError, SequenceInfo};
pub use sequence::{Sequence, first_half_length, footage, second_half};
