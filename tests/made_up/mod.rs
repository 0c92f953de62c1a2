//! Robots made up in a test: pieces of URDF, a folder for them, the command on it.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

/// A link of a mass (kg) whose centre is so far below (above: negative) its joint (m), with a moment of inertia (kg m²) and a shape.
pub fn link(text: &mut String, name: &str, mass: f64, below: f64, inertia: f64, shape: &str) {
    let _ = writeln!(
        text,
        "<link name='{name}'><inertial><origin xyz='0 0 {}'/><mass value='{mass}'/>\
         <inertia ixx='{inertia}' ixy='0' ixz='0' iyy='{inertia}' iyz='0' izz='{inertia}'/></inertial>{shape}</link>",
        -below
    );
}

/// A hinge: parent and child, place (m), axis, range (rad), effort (N m) and velocity (rad/s).
pub fn joint(text: &mut String, ends: [&str; 2], at: [f64; 3], axis: &str, range: [f64; 2], most: [f64; 2]) {
    let ([parent, child], [x, y, z], [lower, upper], [effort, velocity]) = (ends, at, range, most);
    let _ = writeln!(
        text,
        "<joint name='{child}_joint' type='revolute'><origin xyz='{x} {y} {z}'/><parent link='{parent}'/><child link='{child}'/>\
         <axis xyz='{axis}'/><limit lower='{lower}' upper='{upper}' effort='{effort}' velocity='{velocity}'/></joint>"
    );
}

/// A new folder with the robot in it.
pub fn folder(name: &str, file: &str, urdf: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join(file), urdf).unwrap();
    folder
}

/// Exit status, standard output and standard error.
pub fn delmpc(folder: &Path, arguments: &[&str]) -> (Option<i32>, String, String) {
    let output =
        Command::new(env!("CARGO_BIN_EXE_delmpc")).args(arguments).current_dir(folder).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}
