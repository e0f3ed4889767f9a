//! From the worth of pairs to matches: the Hungarian assignment, knot by knot.
//!
//! Pairs that are allowed form a sparse bipartite graph; its connected components are solved one by
//! one, so the cost of a crowd is the cost of its knots.

use crate::track::assign::assign;

/// A match of a track with a detection.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Match {
    /// Index of the track.
    pub track: usize,
    /// Index of the detection.
    pub detection: usize,
    /// Link probability, `[0, 1]`.
    pub link: f64,
}

/// The set of `(track, detection, gain)` pairs, one a track and detection at most, with the greatest
/// total gain. Gains are positive and finite; a pair that must not match is simply not in `pairs`.
/// Returns indices into `pairs`, in increasing order.
pub fn match_pairs(pairs: &[(usize, usize, f64)], tracks: usize, detections: usize) -> Vec<usize> {
    if pairs.is_empty() {
        return Vec::new();
    }
    let mut rivals = vec![0u32; tracks + detections];
    for &(track, detection, _) in pairs {
        rivals[track] += 1;
        rivals[tracks + detection] += 1;
    }
    let mut chosen = Vec::with_capacity(tracks.min(detections));
    let mut contested = Vec::new();
    for (i, &(track, detection, _)) in pairs.iter().enumerate() {
        if rivals[track] == 1 && rivals[tracks + detection] == 1 {
            chosen.push(i);
        } else {
            contested.push(i);
        }
    }
    if !contested.is_empty() {
        let mut component = UnionFind::new(tracks + detections);
        for &i in &contested {
            component.join(pairs[i].0, tracks + pairs[i].1);
        }
        let mut grouped: Vec<(usize, usize)> =
            contested.into_iter().map(|i| (component.root(pairs[i].0), i)).collect();
        grouped.sort_unstable();
        for group in grouped.chunk_by(|a, b| a.0 == b.0) {
            let members = group.iter().map(|&(_, i)| i);
            let (track, detection, _) = pairs[group[0].1];
            let star = members.clone().all(|i| pairs[i].0 == track)
                || members.clone().all(|i| pairs[i].1 == detection);
            if star {
                // All want the same track, or the same detection: the best of them has it.
                chosen.extend(members.max_by(|&a, &b| pairs[a].2.total_cmp(&pairs[b].2)));
            } else {
                solve_component(pairs, members, &mut chosen);
            }
        }
    }
    chosen.sort_unstable();
    chosen
}

fn solve_component(
    pairs: &[(usize, usize, f64)],
    members: impl Iterator<Item = usize> + Clone,
    chosen: &mut Vec<usize>,
) {
    let distinct = |of: fn(&(usize, usize, f64)) -> usize| {
        let mut all: Vec<usize> = members.clone().map(|i| of(&pairs[i])).collect();
        all.sort_unstable();
        all.dedup();
        all
    };
    let (rows, cols) = (distinct(|p| p.0), distinct(|p| p.1));
    let mut cost = vec![0.0; rows.len() * cols.len()];
    let mut index = vec![usize::MAX; cost.len()];
    for i in members {
        let (track, detection, gain) = pairs[i];
        let cell = rows.binary_search(&track).expect("listed") * cols.len()
            + cols.binary_search(&detection).expect("listed");
        cost[cell] = -gain;
        index[cell] = i;
    }
    // A cell that is no pair costs nothing: being assigned to it means staying unmatched.
    for (row, col) in assign(&cost, rows.len(), cols.len()).into_iter().enumerate() {
        if let Some(col) = col {
            let pair = index[row * cols.len() + col];
            if pair != usize::MAX {
                chosen.push(pair);
            }
        }
    }
}

struct UnionFind(Vec<usize>);

impl UnionFind {
    fn new(size: usize) -> Self {
        Self((0..size).collect())
    }

    fn root(&mut self, mut node: usize) -> usize {
        while self.0[node] != node {
            self.0[node] = self.0[self.0[node]];
            node = self.0[node];
        }
        node
    }

    fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.root(a), self.root(b));
        self.0[a.max(b)] = a.min(b);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn best(pairs: &[(usize, usize, f64)], from: usize, used: &mut (u32, u32)) -> f64 {
        let Some(&(track, detection, gain)) = pairs.get(from) else { return 0.0 };
        let mut most = best(pairs, from + 1, used);
        if used.0 & (1 << track) == 0 && used.1 & (1 << detection) == 0 {
            used.0 ^= 1 << track;
            used.1 ^= 1 << detection;
            most = most.max(gain + best(pairs, from + 1, used));
            used.0 ^= 1 << track;
            used.1 ^= 1 << detection;
        }
        most
    }

    proptest! {
        #[test]
        fn total_gain_equals_brute_force(cells in prop::collection::btree_map((0usize..5, 0usize..5), 1u32..50, 0..12)) {
            let pairs: Vec<_> = cells.iter().map(|(&(t, d), &g)| (t, d, f64::from(g))).collect();
            let chosen = match_pairs(&pairs, 5, 5);
            let total: f64 = chosen.iter().map(|&i| pairs[i].2).sum();
            prop_assert!((total - best(&pairs, 0, &mut (0, 0))).abs() < 1e-9);
        }
    }
}
