//! Inverses of the diagonal blocks in double precision: block Jacobi, or scalar Jacobi where a block is singular up to
//! rounding.

use crate::assembly::sell::BLOCK;

/// A pivot smaller than this, relative to its diagonal value, counts as zero.
const PIVOT_ZERO: f64 = 1e-6;

/// Definiteness of a symmetric block, from the signs of its pivots.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Pivots {
    /// Positive definite.
    Positive,
    /// Singular up to rounding.
    Zero,
    /// The block has a direction of negative curvature.
    Negative,
}

/// Classifies a symmetric 3x3 block by the pivots of its elimination, each relative to its original diagonal value.
pub(super) fn pivots(block: &[f64; BLOCK]) -> Pivots {
    let [a, b, c, _, d, e, _, _, f] = *block;
    let (l10, l20) = (b / a, c / a);
    let d1 = d - l10 * b;
    let e1 = e - l10 * c;
    let l21 = if d1.abs() > PIVOT_ZERO * d { e1 / d1 } else { 0.0 };
    let f1 = f - l20 * c - l21 * e1;
    let relative = [1.0, d1 / d, f1 / f];
    // If the second pivot is zero, its off-diagonal entry must be zero too; otherwise the remaining 2x2 block has a
    // negative eigenvalue.
    let hidden = d1.abs() <= PIVOT_ZERO * d && e1.abs() > PIVOT_ZERO.sqrt() * (d * f).sqrt() * 2.0;
    if hidden || relative.iter().any(|&p| p < -PIVOT_ZERO) {
        Pivots::Negative
    } else if relative.iter().any(|&p| p <= PIVOT_ZERO) {
        Pivots::Zero
    } else {
        Pivots::Positive
    }
}

/// Inverse of a symmetric block with positive diagonal, as xx, xy, xz, yy, yz, zz. If the block is singular up to
/// rounding, the inverse of its diagonal.
pub(super) fn inverse_block(block: &[f64; BLOCK]) -> [f64; 6] {
    let [a, b, c, _, d, e, _, _, f] = *block;
    if pivots(block) != Pivots::Positive {
        return [1.0 / a, 0.0, 0.0, 1.0 / d, 0.0, 1.0 / f];
    }
    // The block is scaled to a unit diagonal first, so that entries of very different size neither overflow nor
    // underflow.
    let (p, q, s) = (a.sqrt().recip(), d.sqrt().recip(), f.sqrt().recip());
    let (b, c, e) = (b * p * q, c * p * s, e * q * s);
    let (xx, yy, zz) = (1.0 - e * e, 1.0 - c * c, 1.0 - b * b);
    let (xy, xz, yz) = (c * e - b, b * e - c, b * c - e);
    let scale = 1.0 / (xx + b * xy + c * xz);
    [xx * p * p, xy * p * q, xz * p * s, yy * q * q, yz * q * s, zz * s * s].map(|v| v * scale)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn inverse_of_a_block_by_hand() {
        // [[4,2,0],[2,5,2],[0,2,5]]: determinant 64.
        let inverse = inverse_block(&[4.0, 2.0, 0.0, 2.0, 5.0, 2.0, 0.0, 2.0, 5.0]);
        let exact = [21.0, -10.0, 4.0, 20.0, -8.0, 16.0].map(|v: f64| v / 64.0);
        for (got, want) in inverse.iter().zip(exact) {
            assert!((got - want).abs() < 1e-15, "{inverse:?}");
        }
    }

    #[test]
    fn singular_blocks_fall_back_to_their_diagonal_and_indefinite_ones_are_seen() {
        let ones = [1.0; 9];
        assert_eq!(pivots(&ones), Pivots::Zero);
        assert_eq!(inverse_block(&ones), [1.0, 0.0, 0.0, 1.0, 0.0, 1.0]);
        assert_eq!(pivots(&[1.0, 2.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, 1.0]), Pivots::Negative);
        // Singular upper 2x2 block coupled to the third row.
        assert_eq!(pivots(&[1.0, 1.0, 0.0, 1.0, 1.0, 0.5, 0.0, 0.5, 1.0]), Pivots::Negative);
    }
}
