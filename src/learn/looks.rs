//! Simulated embeddings for sequences that have none, made of those of people who have some.
//!
//! ```text
//! e = normalise(m + sqrt(a) p + sqrt(1 - a) q + d(t))
//! ```
//!
//! `m` is the mean of all, `p` and `q` are what two real people are beside it, `a` is uniform in `[0.5, 1]`: a
//! person of its own, at times much like another. `d(t)` is how a third real person deviates from its mean over
//! time, forwards and backwards from a random moment on: real deviations last for a while and have heavy tails,
//! which Gaussian ones of the same covariance have not (networks trained on such trusted looks too much).
//! A covered person looks partly like whom it is covered by: their embeddings are mixed by the overlap.
//!
//! Figures of networks that are trained so depend on this model; say so beside them.

use std::collections::BTreeMap;

use super::dataset::{LabelledSequence, Owner};
use crate::types::{BBox, Embedding};

/// Least observations of a person that counts.
const LEAST_SEEN: usize = 5;

/// People to make others of.
#[derive(Clone, Debug, PartialEq)]
pub struct Looks {
    mean: Vec<f32>,
    people: Vec<Known>,
}

/// A real person.
#[derive(Clone, Debug, PartialEq)]
struct Known {
    /// Its mean less the mean of all.
    identity: Vec<f32>,
    /// Deviations from its mean, by time, s.
    deviations: Vec<(f64, Vec<f32>)>,
}

/// `to += weight * from`.
fn add(to: &mut [f32], weight: f32, from: &[f32]) {
    to.iter_mut().zip(from).for_each(|(to, from)| *to += weight * from);
}

fn mean<'a>(rows: impl Iterator<Item = &'a [f32]> + Clone) -> Vec<f32> {
    let mut sum = vec![0.0; rows.clone().next().map_or(0, <[f32]>::len)];
    let weight = 1.0 / rows.clone().count().max(1) as f32;
    rows.for_each(|row| add(&mut sum, weight, row));
    sum
}

impl Looks {
    /// Collects the people of `sequences` who have at least 5 embeddings each; `None` where there are fewer
    /// than two. All embeddings are of one width.
    pub fn of(sequences: &[&LabelledSequence]) -> Option<Self> {
        let mut people = vec![];
        for sequence in sequences {
            let mut found: BTreeMap<i64, Vec<(f64, Vec<f32>)>> = BTreeMap::new();
            for frame in &sequence.frames {
                for (owner, embedding) in frame.owners.iter().zip(&frame.embeddings) {
                    if let (Owner::Of(id), Some(embedding)) = (owner, embedding) {
                        let look = (frame.time.since(Default::default()), embedding.as_slice().to_vec());
                        found.entry(*id).or_default().push(look);
                    }
                }
            }
            people.extend(found.into_values().filter(|looks| looks.len() >= LEAST_SEEN));
        }
        if people.len() < 2 {
            return None;
        }
        let means: Vec<Vec<f32>> =
            people.iter().map(|looks| mean(looks.iter().map(|(_, look)| &look[..]))).collect();
        let all = mean(means.iter().map(Vec::as_slice));
        let known = people.into_iter().zip(means).map(|(mut deviations, mut identity)| {
            deviations.iter_mut().for_each(|(_, look)| add(look, -1.0, &identity));
            add(&mut identity, -1.0, &all);
            Known { identity, deviations }
        });
        Some(Self { people: known.collect(), mean: all })
    }

    /// Gives every detection of `sequence` a simulated embedding.
    pub fn dress(&self, sequence: &mut LabelledSequence, rng: &mut fastrand::Rng) {
        let mut people: BTreeMap<i64, Person> = BTreeMap::new();
        for frame in &mut sequence.frames {
            let now = frame.time.since(Default::default());
            let looks: Vec<Vec<f32>> = frame
                .owners
                .iter()
                .map(|owner| match owner {
                    Owner::Of(id) => people.entry(*id).or_insert_with(|| self.person(now, rng)).look(now),
                    // Half of a person, or whatever a false alarm shows.
                    Owner::Near(id) => {
                        let person = people.entry(*id).or_insert_with(|| self.person(now, rng));
                        let mut look = person.look(now);
                        look.iter_mut().for_each(|v| *v *= 0.5);
                        add(&mut look, 0.5, &self.person(now, rng).look(now));
                        look
                    }
                    Owner::Nobody => self.person(now, rng).look(now),
                })
                .collect();
            let boxes: Vec<&BBox> = frame.detections.iter().map(|d| &d.bbox).collect();
            frame.embeddings = (0..boxes.len())
                .map(|own| {
                    let (overlap, other) = covering(&boxes, own);
                    let mut mixed = self.mean.clone();
                    add(&mut mixed, 1.0 - overlap as f32, &looks[own]);
                    add(&mut mixed, overlap as f32, &looks[other]);
                    Embedding::normalised(mixed)
                })
                .collect();
        }
    }

    /// Somebody who has never been.
    fn person(&self, now: f64, rng: &mut fastrand::Rng) -> Person<'_> {
        let [p, q, d] = [(); 3].map(|()| &self.people[rng.usize(..self.people.len())]);
        let share = 0.5 + 0.5 * rng.f32();
        let mut identity = vec![0.0; p.identity.len()];
        add(&mut identity, share.sqrt(), &p.identity);
        add(&mut identity, (1.0 - share).sqrt(), &q.identity);
        let (first, last) = (d.deviations[0].0, d.deviations[d.deviations.len() - 1].0);
        let start = first + rng.f64() * (last - first) * 2.0 - now;
        Person { identity, deviations: &d.deviations, start }
    }
}

/// A simulated person.
struct Person<'a> {
    identity: Vec<f32>,
    deviations: &'a [(f64, Vec<f32>)],
    /// Time of the deviations, run forwards and backwards, at time zero, s.
    start: f64,
}

impl Person<'_> {
    fn look(&self, now: f64) -> Vec<f32> {
        let (first, last) = (self.deviations[0].0, self.deviations[self.deviations.len() - 1].0);
        let span = (last - first).max(1e-3);
        let along = (self.start + now - first).rem_euclid(2.0 * span);
        let time = first + if along > span { 2.0 * span - along } else { along };
        let next = self.deviations.partition_point(|(at, _)| *at < time).clamp(1, self.deviations.len() - 1);
        let [(t0, before), (t1, after)] = [&self.deviations[next - 1], &self.deviations[next]];
        let part = ((time - t0) / (t1 - t0).max(1e-9)).clamp(0.0, 1.0) as f32;
        let mut look = self.identity.clone();
        add(&mut look, 1.0 - part, before);
        add(&mut look, part, after);
        look
    }
}

/// The box in front of box `own` (its feet are lower) that overlaps it the most: IoU, number.
fn covering(boxes: &[&BBox], own: usize) -> (f64, usize) {
    let bottom = |b: &BBox| b.y + b.h;
    let before = (0..boxes.len()).filter(|i| bottom(boxes[*i]) > bottom(boxes[own]));
    before.map(|i| (boxes[own].iou(boxes[i]), i)).fold((0.0, own), |a, b| if b.0 > a.0 { b } else { a })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::learn::dataset::{LabelledFrame, normal};
    use crate::types::{Detection, MediaTime};

    const WIDTH: usize = 16;

    /// `people` people, always there, in `frames` frames a tenth of a second apart.
    fn bare(people: i64, frames: usize) -> LabelledSequence {
        let frame = |index: usize| LabelledFrame {
            time: MediaTime::from_secs(index as f64 / 10.0),
            detections: (0..people)
                .map(|p| Detection::person(BBox::new(100.0 * p as f64, 0.0, 40.0, 100.0), 0.9))
                .collect(),
            owners: (0..people).map(Owner::Of).collect(),
            embeddings: vec![],
        };
        LabelledSequence {
            name: "a".into(),
            group: "a".into(),
            width: 4000.0,
            height: 480.0,
            frame_rate: 10.0,
            frames: (0..frames).map(frame).collect(),
        }
    }

    /// The same with embeddings: a common part, one of the person's, and noise.
    fn real(people: i64, frames: usize, rng: &mut fastrand::Rng) -> LabelledSequence {
        let mut sequence = bare(people, frames);
        let mut draw = |scale: f64| -> Vec<f32> {
            (0..WIDTH).map(|_| (normal(rng) * scale / (WIDTH as f64).sqrt()) as f32).collect()
        };
        let people: Vec<Vec<f32>> = (0..people).map(|_| draw(0.6)).collect();
        for frame in &mut sequence.frames {
            for person in &people {
                let mut look = draw(0.2);
                look[0] += 0.7;
                add(&mut look, 1.0, person);
                frame.embeddings.push(Embedding::normalised(look));
            }
        }
        sequence
    }

    /// Mean cosine of one person in consecutive frames, and of two people in one frame.
    fn cosines(sequence: &LabelledSequence) -> [f64; 2] {
        let (mut same, mut other) = (vec![], vec![]);
        for pair in sequence.frames.windows(2) {
            let [now, next] = [0, 1].map(|i| pair[i].embeddings.iter().flatten().collect::<Vec<_>>());
            for (i, look) in now.iter().enumerate() {
                same.push(look.cosine(next[i]));
                other.extend(now[..i].iter().map(|other| other.cosine(look)));
            }
        }
        [same, other].map(|values| values.iter().sum::<f64>() / values.len() as f64)
    }

    #[test]
    fn the_simulated_are_as_alike_and_as_different_as_the_real() {
        let mut rng = fastrand::Rng::with_seed(3);
        let world = real(40, 60, &mut rng);
        let mut dressed = bare(60, 40);
        Looks::of(&[&world]).expect("40 people").dress(&mut dressed, &mut rng);
        let ([same, other], [same_real, other_real]) = (cosines(&dressed), cosines(&world));
        assert!((same - same_real).abs() < 0.03, "one person: {same}, really {same_real}");
        assert!((other - other_real).abs() < 0.06, "two: {other}, really {other_real}");
        assert_eq!(Looks::of(&[&bare(6, 20)]), None, "nothing to learn from");
    }

    #[test]
    fn deviations_run_forwards_and_backwards() {
        let deviations: Vec<(f64, Vec<f32>)> = (0..3).map(|i| (f64::from(i), vec![i as f32])).collect();
        let person = Person { identity: vec![10.0], deviations: &deviations, start: 0.0 };
        let looks: Vec<f32> = (0..9).map(|now| person.look(f64::from(now))[0]).collect();
        assert_eq!(looks, [10.0, 11.0, 12.0, 11.0, 10.0, 11.0, 12.0, 11.0, 10.0]);
    }

    #[test]
    fn the_covered_look_like_whom_they_are_covered_by() {
        let [back, front] = [BBox::new(0.0, 0.0, 40.0, 90.0), BBox::new(0.0, 10.0, 40.0, 90.0)];
        let (overlap, by) = covering(&[&back, &front], 0);
        assert!(overlap > 0.7 && by == 1);
        assert_eq!(covering(&[&back, &front], 1), (0.0, 1), "nobody covers the one in front");
    }
}
