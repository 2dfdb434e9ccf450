//! Meshes of shapes whose depth is known exactly.
use crate::{Built, Collider, Frame, Nearest, Simplify, Surface, Tsdf, TsdfOptions, build, samples};
use glam::{DMat3, DVec2, DVec3, Vec3};
use splatvk_types::scene::{Camera, Image, Pose, RgbImage};

const RADIUS: f64 = 0.4;
const PLANE: f64 = 0.0123;

/// A camera at `from` that looks at the origin.
fn camera(from: DVec3) -> Camera {
    let forward = -from.normalize();
    let right = forward.cross(forward.any_orthonormal_vector()).normalize();
    let rotation = DMat3::from_cols(right, forward.cross(right), forward).transpose();
    let pose = Pose { rotation, translation: -(rotation * from) };
    Camera { name: "a".into(), width: 160, height: 120, fx: 150.0, fy: 150.0, cx: 80.0, cy: 60.0, pose }
}

/// A frame of a surface; `hit` has the camera z of a ray from `centre` along `ray` (z = 1 in camera
/// axes) and a label.
fn frame(camera: Camera, hit: impl Fn(DVec3, DVec3) -> Option<(f64, u32)>) -> Frame {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let (mut depth, mut labels) = (Image::filled(width, height, 0.0), Image::filled(width, height, 0));
    let mut colour = RgbImage { width, height, data: vec![[0.0; 3]; width * height] };
    let turn = camera.pose.rotation.transpose();
    for i in 0..width * height {
        let pixel = DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
        if let Some((z, label)) = hit(camera.pose.centre(), turn * camera.ray(pixel)) {
            (depth.data[i], labels.data[i]) = (z as f32, label);
            colour.data[i] = if label == 2 { [1.0, 0.0, 0.0] } else { [0.5; 3] };
        }
    }
    let weight = Image { width, height, data: depth.data.iter().map(|z| f32::from(*z > 0.0)).collect() };
    Frame { camera, depth, weight, colour, colour_weight: 1.0, labels: Some(labels) }
}

fn sphere(centre: DVec3, ray: DVec3) -> Option<(f64, u32)> {
    let (a, b) = (ray.length_squared(), centre.dot(ray));
    let root = b * b - a * (centre.length_squared() - RADIUS * RADIUS);
    let z = (-b - root.max(0.0).sqrt()) / a;
    (root > 0.0).then_some((z, 1 + u32::from((centre + ray * z).x > 0.0)))
}

/// The plane z = 0.0123, tilted against all cameras.
fn plane(centre: DVec3, ray: DVec3) -> Option<(f64, u32)> {
    let z = (PLANE - centre.z) / ray.z;
    (z > 0.0 && (centre + ray * z).length() < 0.6).then_some((z, 1))
}

fn around(count: usize, share: f64) -> Vec<Frame> {
    // Fibonacci sphere.
    let at = |i: usize| {
        let y = 1.0 - 2.0 * (i as f64 + 0.5) / count as f64;
        let (angle, r) = (2.4 * i as f64, (1.0 - y * y).sqrt());
        DVec3::new(r * angle.cos(), y, r * angle.sin()) * 1.6
    };
    let used = (0..count).map(at).filter(|p| p.y > 1.6 * (1.0 - 2.0 * share));
    used.map(|p| frame(camera(p), sphere)).collect()
}

fn surface(frames: &[Frame]) -> (Surface, f64) {
    let tsdf = Tsdf::new(frames, TsdfOptions::default()).unwrap();
    (tsdf.surface(), tsdf.voxel())
}

fn mesh_of(frames: &[Frame], how: Simplify) -> (Built, f64) {
    let (mut surface, voxel) = surface(frames);
    surface.drop_small(1e-3);
    (build(&surface, voxel, how, |label| format!("part {label}")), voxel)
}

/// Largest distance of the vertices to the sphere.
fn off_sphere(positions: impl Iterator<Item = Vec3>) -> f64 {
    positions.map(|p| (f64::from(p.length()) - RADIUS).abs()).fold(0.0, f64::max)
}

#[test]
fn sphere_seen_from_all_sides_is_closed() {
    let (surface, voxel) = surface(&around(24, 1.0));
    assert_eq!(surface.border_edges(), 0);
    assert!(off_sphere(surface.positions.iter().copied()) < 0.5 * voxel);
    let area: f64 = surface.triangles.iter().map(|t| surface.area(*t)).sum();
    let true_area = 4.0 * std::f64::consts::PI * RADIUS * RADIUS;
    assert!((area / true_area - 1.0).abs() < 0.02, "{area} {true_area}");
    let outwards = surface.normals().iter().zip(&surface.positions).all(|(n, p)| n.dot(*p) > 0.0);
    assert!(outwards);
}

#[test]
fn sphere_seen_from_one_side_stays_open() {
    let (surface, voxel) = surface(&around(24, 0.2));
    assert!(surface.border_edges() > 50);
    assert!(off_sphere(surface.positions.iter().copied()) < voxel);
    let lowest = surface.positions.iter().fold(f32::MAX, |y, p| y.min(p.y));
    assert!(f64::from(lowest) > -0.75 * RADIUS, "no photo sees the side below: {lowest}");
}

#[test]
fn plane_is_exact_below_half_a_voxel() {
    let views = [DVec3::new(0.6, 0.2, -1.5), DVec3::new(-0.5, -0.4, -1.2), DVec3::new(0.1, 0.9, -1.4)];
    let frames: Vec<Frame> = views.iter().map(|p| frame(camera(*p), plane)).collect();
    let (surface, voxel) = surface(&frames);
    assert!(surface.triangles.len() > 1000);
    let worst = surface.positions.iter().fold(0.0f32, |w, p| w.max((p.z - PLANE as f32).abs()));
    assert!(f64::from(worst) < 0.1 * voxel, "{worst} {voxel}");
    assert!(surface.normals().iter().all(|n| n.z < -0.99), "they face the cameras");
}

#[test]
fn voxels_beyond_memory_are_refused() {
    let frames = around(4, 1.0);
    let options = |voxel| TsdfOptions { voxel: Some(voxel), most_blocks: 1000, ..TsdfOptions::default() };
    assert!(Tsdf::new(&frames, options(0.02)).is_ok());
    let error = Tsdf::new(&frames, options(0.002)).err().unwrap();
    assert!(error.exit_code() == 2 && error.to_string().contains("larger"), "{error}");
    let grown = Tsdf::new(&frames, TsdfOptions { voxel: None, ..options(1.0) }).unwrap();
    let free = Tsdf::new(&frames, TsdfOptions::default()).unwrap();
    assert!(grown.voxel() >= free.voxel());
}

#[test]
fn mesh_is_the_same_in_every_run() {
    let frames = around(12, 1.0);
    let [a, b] = [(); 2].map(|()| mesh_of(&frames, Simplify::Triangles(2000)).0.mesh);
    assert_eq!(a, b);
}

#[test]
fn simplification_keeps_its_bounds() {
    let frames = around(24, 1.0);
    let (full, voxel) = mesh_of(&frames, Simplify::None);
    let (few, _) = mesh_of(&frames, Simplify::Triangles(1000));
    assert!(full.mesh.triangles.len() > 5000 && full.error == 0.0);
    assert!((800..=1000).contains(&few.mesh.triangles.len()), "{}", few.mesh.triangles.len());
    let bound = 0.5 * voxel;
    let (close, _) = mesh_of(&frames, Simplify::Error(bound));
    assert!(close.mesh.triangles.len() < full.mesh.triangles.len() / 2 && close.error <= bound);
    assert!(few.error > 0.0);
    let nearest = Nearest::new(&full.mesh.positions, &full.mesh.triangles).unwrap();
    let moved = nearest.distances(&samples(&close.mesh, 20_000));
    let far = moved.iter().filter(|d| f64::from(**d) > bound).count();
    assert!(far <= 40, "{far} of 20000 points are beyond {bound}");
    let worst = moved.iter().fold(0.0f32, |w, d| w.max(*d));
    assert!(f64::from(worst) <= 2.0 * bound, "{worst} {bound}");
}

#[test]
fn labels_become_parts_with_their_colours() {
    let frames = around(24, 1.0);
    let (built, voxel) = mesh_of(&frames, Simplify::Triangles(4000));
    let mesh = built.mesh;
    let names: Vec<&str> = mesh.parts.iter().map(|p| p.name.as_str()).collect();
    assert_eq!(names, ["part 1", "part 2"]);
    assert_eq!(mesh.parts[1].triangles.end, mesh.triangles.len());
    let (full, _) = mesh_of(&frames, Simplify::None);
    for (part, side) in full.mesh.parts.iter().zip([-1.0, 1.0]) {
        let own = full.mesh.part(part);
        assert!(own.positions.iter().all(|p| f64::from(side * p[0]) > -2.0 * voxel));
        let red = own.colours.iter().filter(|c| c[0] > 0.9 && c[1] < 0.1).count();
        let share = red as f32 / own.colours.len() as f32;
        assert!(if side > 0.0 { share > 0.9 } else { share < 0.1 }, "{share}");
    }
    let positions: std::collections::HashSet<_> =
        mesh.positions.iter().map(|p| p.map(f32::to_bits)).collect();
    assert!(positions.len() < mesh.positions.len(), "parts have vertices of their own at their border");
    let welded: std::collections::BTreeMap<_, u32> =
        positions.into_iter().enumerate().map(|(i, p)| (p, i as u32)).collect();
    let joined: Vec<[u32; 3]> =
        (0..mesh.triangles.len()).map(|t| mesh.corners(t).map(|p| welded[&p.map(f32::to_bits)])).collect();
    assert_eq!(crate::border_edges(&joined), 0, "no crack between the parts");
}

#[test]
fn colliders_contain_the_mesh() {
    let (built, _) = mesh_of(&around(24, 1.0), Simplify::Triangles(2000));
    for collider in [Collider::Hull, Collider::Decomposition] {
        let hulls = collider.shapes(&built.mesh);
        assert!(!hulls.is_empty() && hulls.iter().all(|h| crate::border_edges(&h.triangles) == 0));
        for p in &built.mesh.positions {
            let outside = hulls.iter().map(|hull| farthest_outside(hull, *p)).fold(f32::MAX, f32::min);
            assert!(outside < 1e-5, "{collider:?} {outside}");
        }
    }
    let flat = splatvk_types::scene::Mesh { positions: vec![[0.0; 3]; 3], ..Default::default() };
    assert!(Collider::Hull.shapes(&flat).is_empty());
}

/// Distance of a point beyond the faces of a hull; ≤ 0 inside.
fn farthest_outside(hull: &splatvk_types::scene::Hull, point: [f32; 3]) -> f32 {
    let beyond = |t: &[u32; 3]| {
        let [a, b, c] = t.map(|v| Vec3::from_array(hull.positions[v as usize]));
        (b - a).cross(c - a).normalize().dot(Vec3::from_array(point) - a)
    };
    hull.triangles.iter().map(beyond).fold(f32::MIN, f32::max)
}
