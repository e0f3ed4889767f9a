//! The model card: what a network is, what it was trained on, how it does on what it has not seen.

use std::fmt::Write as _;

use crate::track::Features;

/// Facts of a training run.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Card {
    /// The file's name.
    pub file: String,
    /// The file's size in bytes.
    pub bytes: usize,
    /// Licence of the data, and what follows for the weights.
    pub licence: String,
    /// Whether it gives the weights of explicit features instead of the probability itself.
    pub explicit: bool,
    /// What it reads.
    pub features: Features,
    /// Width of the hidden state.
    pub hidden: usize,
    /// Number of parameters.
    pub parameters: usize,
    /// Names of the sequences that it was trained on.
    pub sequences: Vec<String>,
    /// Names of those that were held out.
    pub excluded: Vec<String>,
    /// Examples and the share of positives among them.
    pub examples: (usize, f64),
    /// Boxes that the existence head was trained on and the share of positives among them.
    pub boxes: (usize, f64),
    /// Settings as (name, value).
    pub settings: Vec<(String, String)>,
    /// What networks of the same recipe score on sequences that they did not see.
    pub unseen: Vec<Unseen>,
}

/// Scores of one sequence under a network that never saw its footage.
#[derive(Clone, Debug, Default, PartialEq)]
#[cfg_attr(feature = "cli", derive(serde::Serialize, serde::Deserialize))]
pub struct Unseen {
    /// Name of the sequence.
    pub sequence: String,
    /// Whether only its second half was tracked (a detector trained on the first).
    pub second_half: bool,
    /// Pairs that the tracker would ask about.
    pub pairs: usize,
    /// Area under the ROC curve of these pairs.
    pub auc: f64,
    /// Their binary cross-entropy, nats.
    pub loss: f64,
    /// Their expected calibration error.
    pub calibration_error: f64,
    /// HOTA of the tracker, per cent.
    pub hota: f64,
    /// MOTA of the tracker, per cent.
    pub mota: f64,
    /// IDF1 of the tracker, per cent.
    pub idf1: f64,
    /// Identity switches.
    pub id_switches: u64,
}

/// The licence notice of weights trained on MOTChallenge.
pub const MOTCHALLENGE_LICENCE: &str = "The weights are trained on annotations and detections of MOTChallenge (MOT15, MOT17), which are \
licensed CC BY-NC-SA 3.0: attribution, non-commercial, share alike. Treat the weights as bound by it \
unless you know better; train your own on data of your own for other uses. The program's code is not \
affected.";

impl Card {
    /// The card as Markdown.
    pub fn markdown(&self) -> String {
        let mut out = String::new();
        let sees = match self.features {
            Features::Relative => "Boxes only: it sees neither pixels nor the place in the picture.".into(),
            Features::Appearance { embedding } => {
                format!(
                    "Boxes, not their place in the picture, and how alike embeddings of {embedding} numbers \
                     are: it is good for embeddings of the kind that it was trained on."
                )
            }
            Features::Literal { embedding } => {
                format!("Boxes with their place in the picture and embeddings of {embedding} numbers.")
            }
        };
        let _ = write!(
            out,
            "# {}: link network\n\n\
             Says how probable it is that a detection continues a track, from up to 6 observations of the \
             track and the detection. A GRU of {} units, the reset gate before the matrix product{}, {} \
             parameters, {} bytes of ONNX. {} \
             Written by `gakp train`.\n\n\
             ## Licence of the data\n{}\n\n\
             ## Input and output\n\
             | | name | type |\n| --- | --- | --- |\n\
             | in | `histories` | f32 `[T, 6, {}]`, observations packed from index 0, oldest first |\n\
             | in | `lengths` | i32 `[T]`, 1 to 6 |\n\
             | in | `candidates` | f32 `[P, {}]` |\n\
             | in | `pair_track` | i64 `[P]`, row of `histories` |\n\
             | out | `probability` | f32 `[P]` |\n\n\
             The features are those of `src/track/features/{}.rs`, raw: normalisation is in the graph. T and P \
             must be at least 1.\n\n",
            self.file,
            self.hidden,
            if self.explicit {
                ", over the track alone: it gives the weights of explicit features of the pair, and the \
                 probability is the logistic function of their weighted sum"
            } else {
                ""
            },
            self.parameters,
            self.bytes,
            sees,
            self.licence,
            self.features.step(),
            self.features.candidate(),
            self.features.name()
        );
        let _ =
            writeln!(out, "## Data\nSequences ({}): {}.", self.sequences.len(), self.sequences.join(", "));
        if !self.excluded.is_empty() {
            let _ = writeln!(out, "Held out: {}.", self.excluded.join(", "));
        }
        let (examples, positive) = self.examples;
        let (boxes, right) = self.boxes;
        let _ = write!(
            out,
            "{examples} pairs, {:.1} % of them positive. Detections belong to the truth that they overlap by \
             0.5 or more, one to one. The tracker core is driven by the true identities; its gate is opened \
             wider; tracks lose their detections for up to 1.5 s now and then, so that gaps are seen; copies \
             are mirrored, thinned to a half and a third of the frames, with noise on the boxes and missing \
             detections.\n\n\
             The file's metadata holds the existence head, a perceptron of 15, 12, 12 and 1 units that says \
             which boxes of confirmed tracks are output (`src/track/existence.rs`). It was trained on the \
             {boxes} boxes that the tracker makes with this network on the same sequences, {:.1} % of them right.\n\n\
             ## Settings\n| | |\n| --- | --- |\n",
            100.0 * positive,
            100.0 * right
        );
        for (name, value) in &self.settings {
            let _ = writeln!(out, "| {name} | {value} |");
        }
        if !self.unseen.is_empty() {
            out.push_str(&unseen_section(&self.unseen));
        }
        out.push_str(
            "\n## Limits\nPeople, seen mostly from the front and the side, at 7 to 30 frames a second. After a \
             gap of about 2 s boxes alone say little. Probabilities are for the pairs that the tracker's gate \
             lets through; they are trained with weights that favour hard pairs and are not exactly calibrated.\n",
        );
        out
    }
}

fn unseen_section(unseen: &[Unseen]) -> String {
    let mut out = String::from(
        "\n## Scores on footage that it did not see\n\
         One network of this recipe for each footage, trained without it and without its copies by other \
         detectors, with a filter of its own where tunings were given; the tracker with its default settings else. AUC, cross-entropy and calibration error are of \
         the pairs that the tracker asks about while it is driven by the truth.\n\n\
         | sequence | pairs | AUC | cross-entropy | calibration error | HOTA | MOTA | IDF1 | IDs |\n\
         | --- | --- | --- | --- | --- | --- | --- | --- | --- |\n",
    );
    for u in unseen {
        let half = if u.second_half { " (second half)" } else { "" };
        let _ = writeln!(
            out,
            "| {}{half} | {} | {:.4} | {:.4} | {:.4} | {:.2} | {:.2} | {:.2} | {} |",
            u.sequence, u.pairs, u.auc, u.loss, u.calibration_error, u.hota, u.mota, u.idf1, u.id_switches
        );
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_the_licence_and_what_was_held_out() {
        let card = Card {
            file: "x.onnx".into(),
            licence: MOTCHALLENGE_LICENCE.into(),
            excluded: vec!["MOT17-02-SDP".into()],
            unseen: vec![Unseen { sequence: "MOT17-02-SDP".into(), auc: 0.98765, ..Unseen::default() }],
            ..Card::default()
        };
        let text = card.markdown();
        for expected in ["CC BY-NC-SA 3.0", "Held out: MOT17-02-SDP.", "| MOT17-02-SDP | 0 | 0.9877 |"] {
            assert!(text.contains(expected), "{expected:?} is not in\n{text}");
        }
    }
}
