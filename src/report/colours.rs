//! The colours of all pictures.

use crate::report::canvas::Colour;

/// Paper.
pub const WHITE: Colour = [255, 255, 255, 255];
/// Letters and frames.
pub const INK: Colour = [23, 32, 43, 255];
/// What is said by the way.
pub const SOFT: Colour = [85, 98, 115, 255];
/// Lines behind the plots.
pub const GRID: Colour = [226, 231, 237, 255];
/// Told apart by people who do not see all colours. Source: Okabe and Ito, "Color Universal Design" (2008).
pub const PALETTE: [Colour; 6] = [
    [0, 114, 178, 255],
    [213, 94, 0, 255],
    [0, 158, 115, 255],
    [204, 121, 167, 255],
    [230, 159, 0, 255],
    [86, 180, 233, 255],
];
/// Limits and the like: drawn and left out, in pixels.
pub const DASH: Option<[f32; 2]> = Some([9.0, 7.0]);
