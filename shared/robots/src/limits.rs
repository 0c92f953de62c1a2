//! Caps that bound time and memory on any input, hostile or broken. Far above every real robot.

/// Largest URDF file, bytes.
pub const MAX_URDF_BYTES: usize = 2 << 20;
/// Largest companion file, bytes.
pub const MAX_COMPANION_BYTES: usize = 256 << 10;
/// Most XML elements in a URDF file.
pub const MAX_ELEMENTS: usize = 20_000;
/// Most attributes of one XML element.
pub const MAX_ATTRIBUTES: usize = 64;
/// Deepest nesting of XML elements (a URDF needs 6).
pub const MAX_DEPTH: usize = 24;
/// Most joint coordinates of a robot.
pub const MAX_COORDINATES: usize = 1024;
