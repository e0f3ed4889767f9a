//! Where people were, as seconds in a grid over the picture.

use super::geometry::Point;

/// Columns of the grid.
pub const HEAT_COLUMNS: usize = 64;
/// Rows of the grid.
pub const HEAT_ROWS: usize = 36;

/// Seconds that people stood in each cell of a grid over the picture, since the camera was started.
#[derive(Clone, Debug, PartialEq)]
pub struct Heat {
    /// Row by row from the top left.
    cells: Vec<f64>,
}

impl Default for Heat {
    fn default() -> Self {
        Self { cells: vec![0.0; HEAT_COLUMNS * HEAT_ROWS] }
    }
}

impl Heat {
    /// Row by row from the top left, [`HEAT_COLUMNS`] a row.
    pub fn cells(&self) -> &[f64] {
        &self.cells
    }

    /// Someone was at `place`, a fraction of the picture, for `seconds`. Feet below the picture count at its edge.
    pub(super) fn add(&mut self, place: Point, seconds: f64) {
        let cell = |v: f64, n: usize| ((v * n as f64) as usize).min(n - 1);
        self.cells[cell(place.y, HEAT_ROWS) * HEAT_COLUMNS + cell(place.x, HEAT_COLUMNS)] += seconds;
    }
}
