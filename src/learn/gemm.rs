//! A bounds-checked face of `matrixmultiply`.

/// A matrix within a slice: element `(i, j)` is at `i * strides.0 + j * strides.1`.
#[derive(Clone, Copy)]
pub(super) struct View<'a> {
    /// The values from element (0, 0) on.
    pub data: &'a [f32],
    /// Row stride, column stride.
    pub strides: (usize, usize),
}

impl<'a> View<'a> {
    /// Row-major with rows `stride` apart.
    pub fn rows(data: &'a [f32], stride: usize) -> Self {
        Self { data, strides: (stride, 1) }
    }

    /// The transpose of a row-major matrix whose rows are `stride` apart.
    pub fn transposed(data: &'a [f32], stride: usize) -> Self {
        Self { data, strides: (1, stride) }
    }
}

/// Whether an `m x n` matrix with these strides lies within `len` values.
fn fits(m: usize, n: usize, (rs, cs): (usize, usize), len: usize) -> bool {
    m == 0 || n == 0 || (m - 1) * rs + (n - 1) * cs < len
}

/// `C = A B + beta C` for `A` of `m x k`, `B` of `k x n`, `C` row-major with rows `stride` apart.
///
/// # Panics
/// When a matrix reaches outside its slice.
pub(super) fn gemm(
    (m, k, n): (usize, usize, usize),
    a: View<'_>,
    b: View<'_>,
    beta: f32,
    c: &mut [f32],
    stride: usize,
) {
    assert!(fits(m, k, a.strides, a.data.len()), "left matrix {m} x {k} outside its slice");
    assert!(fits(k, n, b.strides, b.data.len()), "right matrix {k} x {n} outside its slice");
    assert!(stride >= n && fits(m, n, (stride, 1), c.len()), "product {m} x {n} outside its slice");
    if m == 0 || n == 0 {
        return;
    }
    // SAFETY: every element that the strides reach lies within its slice (asserted above), the
    // product's rows do not overlap (stride >= n), and `c` is borrowed exclusively.
    unsafe {
        matrixmultiply::sgemm(
            m,
            k,
            n,
            1.0,
            a.data.as_ptr(),
            a.strides.0 as isize,
            a.strides.1 as isize,
            b.data.as_ptr(),
            b.strides.0 as isize,
            b.strides.1 as isize,
            beta,
            c.as_mut_ptr(),
            stride as isize,
            1,
        );
    }
}
