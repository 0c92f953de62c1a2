//! Mesh files of a robot: found by the names that its URDF has for them, read as triangles.
//!
//! | name | where it is looked for |
//! |---|---|
//! | `file:///a/b.stl`, `/a/b.stl` | there |
//! | `meshes/b.stl` | from the folder of the URDF |
//! | `package://robot/meshes/b.stl` | `robot/meshes/b.stl` and `meshes/b.stl` in that folder and in those above it |
//!
//! Read are STL, OBJ and COLLADA files of up to 64 MB.

use std::path::{Path, PathBuf};

use delmpc_mechanics::prelude::RigidTransform;
use delmpc_robots::{Mesh, RobotModel};
use mesh_loader::Loader;
use nalgebra::Vector3;

/// Larger files are not read, bytes.
const MOST_BYTES: u64 = 64 << 20;

/// Triangles in the axes of the body that carries the mesh.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Triangles {
    /// Corners, m.
    pub points: Vec<Vector3<f64>>,
    /// Three corners each, as indices.
    pub faces: Vec<[usize; 3]>,
}

/// The folder that names of meshes are relative to.
pub fn folder_of(robot: &RobotModel) -> PathBuf {
    let folder = robot.mesh_folder.clone();
    folder.unwrap_or_else(|| robot.file.parent().map(Path::to_owned).unwrap_or_default())
}

/// Reads a mesh of a robot; `None` when its file is not there or cannot be read.
pub fn read(robot: &RobotModel, mesh: &Mesh) -> Option<Triangles> {
    let path = find(&folder_of(robot), &mesh.file)?;
    let size = std::fs::metadata(&path).ok()?.len();
    if size > MOST_BYTES {
        return None;
    }
    // Names end in .STL as well.
    let lower = PathBuf::from(path.to_string_lossy().to_lowercase());
    let scene =
        Loader::default().merge_meshes(true).load_from_slice(&std::fs::read(&path).ok()?, lower).ok()?;
    let mesh_data = scene.meshes.into_iter().next()?;
    let pose: &RigidTransform = &mesh.attachment.pose;
    let to_body = |vertex: &[f32; 3]| {
        let vertex = Vector3::from(vertex.map(f64::from)).component_mul(&mesh.scale);
        pose.transform_point(&vertex)
    };
    let points: Vec<Vector3<f64>> = mesh_data.vertices.iter().map(to_body).collect();
    let faces = mesh_data.faces.iter().map(|face| face.map(|corner| corner as usize));
    let faces: Vec<[usize; 3]> =
        faces.filter(|face| face.iter().all(|corner| *corner < points.len())).collect();
    let sound = !points.is_empty() && points.iter().all(|point| point.iter().all(|x| x.is_finite()));
    sound.then_some(Triangles { points, faces })
}

/// Where the file of that name is.
fn find(folder: &Path, name: &str) -> Option<PathBuf> {
    let present = |path: PathBuf| path.is_file().then_some(path);
    if let Some(path) = name.strip_prefix("file://") {
        return present(PathBuf::from(path));
    }
    let Some(rest) = name.strip_prefix("package://").or_else(|| name.strip_prefix("model://")) else {
        return present(folder.join(name));
    };
    let rest = rest.trim_start_matches('/');
    let inside = rest.split_once('/').map(|(_, inside)| inside);
    let folder = folder.canonicalize().ok()?;
    folder.ancestors().find_map(|above| {
        present(above.join(rest)).or_else(|| inside.and_then(|inside| present(above.join(inside))))
    })
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]
mod tests {
    use super::*;

    #[test]
    fn files_are_found_by_the_names_of_the_field() {
        let root = std::env::temp_dir().join(format!("delmpc-mesh-{}", std::process::id()));
        let urdf = root.join("robot/urdf");
        std::fs::create_dir_all(&urdf).unwrap();
        std::fs::create_dir_all(root.join("robot/meshes")).unwrap();
        let file = root.join("robot/meshes/a.stl");
        std::fs::write(&file, "solid").unwrap();
        let found = |name: &str| find(&urdf, name).map(|path| path.canonicalize().unwrap());
        let file = file.canonicalize().unwrap();
        for name in ["package://robot/meshes/a.stl", "package:///meshes/a.stl", "../meshes/a.stl"] {
            assert_eq!(found(name).as_ref(), Some(&file), "{name}");
        }
        assert_eq!(found(&format!("file://{}", file.display())), Some(file));
        assert_eq!(found("package://robot/meshes/b.stl"), None);
        std::fs::remove_dir_all(root).unwrap();
    }
}
