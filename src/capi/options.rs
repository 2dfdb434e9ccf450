//! Enumerations and structures of labels, meshes, exports, lists of things, and edits.
use super::types::SvkProgressFunction;
use std::ffi::{c_char, c_void};

/// Shapes for physics beside every part of a mesh.
#[repr(u32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SvkCollider {
    /// None.
    None = 0,
    /// The convex hull.
    Hull = 1,
    /// Convex pieces that follow the shape (V-HACD).
    Decomposition = 2,
}

/// Axis that points up in an exported file.
#[repr(u32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SvkUpAxis {
    /// y in .spz, .glb and .gltf, else -y, where the scene states the direction up.
    Auto = 0,
    /// -y: right, down, forward, as in cameras.
    MinusY = 1,
    /// y: right, up, back.
    Y = 2,
    /// z: right, forward, up.
    Z = 3,
}

/// Level of the files of svk_scene_objects.
#[repr(u32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SvkPieces {
    /// Things and surfaces, none of them within another.
    Things = 0,
    /// Masks of parts.
    Parts = 1,
    /// Parts of parts.
    Subparts = 2,
    /// Masks of wholes, which may join things with their table.
    Wholes = 3,
}

/// Operation of an edit.
#[repr(u32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SvkOperation {
    /// Removes the selected splats.
    Delete = 0,
    /// Removes all other splats.
    Isolate = 1,
    /// Gives the selected splats a mean colour; each keeps its brightness against the mean.
    Recolour = 2,
    /// Moves the selected splats.
    Move = 3,
    /// Removes splats in free space, in front of the surfaces that photos show.
    Floaters = 4,
}

/// Options of svk_label. Zero is the default of every field but `size`: photos of a scene directory,
/// or else 24 views that are rendered from the splats.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkLabelOptions {
    /// sizeof(SvkLabelOptions)
    pub size: usize,
    /// Folder of the photos of the training; needs `cameras`. NULL = none.
    pub images: *const c_char,
    /// Cameras in the coordinates of the splats: transforms.json, a COLMAP model folder or
    /// cameras.json; without `images` the splats are rendered from them. NULL = none.
    pub cameras: *const c_char,
    /// Folder of a mask per photo of `images`, as of --photo-masks; NULL = masks beside the photos,
    /// if there are any.
    pub photo_masks: *const c_char,
    /// Number of photos or cameras that are used; needs `cameras`. 0 = 16 photos, or 24 cameras.
    pub views: u32,
    /// Number of views that are rendered from cameras in free space, at most 200; not with
    /// `cameras`. 0 = 24 where there are neither photos nor cameras.
    pub synthesize: u32,
    /// Longer side of the working images, pixels. 0 = 800 on a CPU device, 1600 on a GPU.
    pub max_size: u64,
    /// Source of masks, as of --masks. NULL = built-in.
    pub mask_source: *const c_char,
    /// Source of region features, as of --features. NULL = built-in.
    pub feature_source: *const c_char,
    /// Points along each side of a picture at which a mask network is asked, at most 128; 0 = 32.
    pub mask_points: u32,
    /// 1 = do not ask the mask network about four overlapping crops as well.
    pub no_mask_crops: u32,
    /// Scene directory to write, whole or not at all; NULL = the scene stays in memory.
    pub out: *const c_char,
    /// 1 = replace a scene directory at `out`.
    pub replace: u64,
    /// Progress callback; may be NULL.
    pub progress: SvkProgressFunction,
    /// First argument of `progress`.
    pub user: *mut c_void,
}

/// Options of svk_scene_export. Zero is the default of every field but `size`: upright and in
/// metres, as far as the scene states them, without what no photo shows.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkExportOptions {
    /// sizeof(SvkExportOptions)
    pub size: usize,
    /// Name of the format, as of --format; NULL = by the ending of the path.
    pub format: *const c_char,
    /// html: heading of the page; NULL = the name of the scene.
    pub title: *const c_char,
    /// html: file of named views; NULL = views.json of the scene.
    pub views: *const c_char,
    /// SvkUpAxis. An axis is SVK_STATUS_INPUT where the direction up is not known.
    pub up: u32,
    /// 1 = a scene whose metres are not known is SVK_STATUS_INPUT.
    pub metres: u32,
    /// 1 = keep the axes and the unit of the scene, except for those that `up` and `metres` name.
    pub raw: u32,
    /// 1 = keep what no photo shows: surfaces continued beyond the photos, colours behind the
    /// scene.
    pub guessed: u32,
    /// ply: 1 = language features and codes as extra columns.
    pub with_features: u32,
    /// ply: SvkShDegree of the file, padded with zeros; SVK_SH_DEGREE_AUTO = 3.
    pub ply_degree: u32,
    /// spz: version of the file, 2 to 4; 0 = 3.
    pub spz_version: u32,
    /// 1 = replace an ordinary file, or files of the same names in a folder.
    pub replace: u32,
    /// Progress callback; may be NULL.
    pub progress: SvkProgressFunction,
    /// First argument of `progress`.
    pub user: *mut c_void,
}

/// Options of svk_scene_mesh. Zero is the default of every field but `size`: upright, in metres and
/// on the ground, as far as the scene states them. A length is "2mm", "0.5cm" or "0.01m" where the
/// scale of the scene is known, or a number in its units.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkMeshOptions {
    /// sizeof(SvkMeshOptions)
    pub size: usize,
    /// Most triangles; 0 = 100,000.
    pub triangles: u64,
    /// Instead of `triangles`: length by which 99.9 % of the surface may move. NULL = `triangles`.
    pub error: *const c_char,
    /// Side of a voxel; NULL = two pixels of the photos at their surfaces.
    pub voxel: *const c_char,
    /// Cameras to look from: transforms.json, a COLMAP model folder or cameras.json; a file of
    /// Gaussians needs them. NULL = those of the scene.
    pub cameras: *const c_char,
    /// Names of things to choose from, one a line; needs `by_object`. NULL = those of the text
    /// model.
    pub vocabulary: *const c_char,
    /// SvkCollider; not for .ply.
    pub collider: u32,
    /// 1 = a part with a name for every thing of the scene, which must have language.
    pub by_object: u32,
    /// 1 = also surfaces that no photo shows; otherwise they are holes.
    pub fill_guessed: u32,
    /// 1 = keep the axes, the unit and the origin of the scene.
    pub raw: u32,
    /// 1 = replace an ordinary file.
    pub replace: u64,
    /// Progress callback; may be NULL.
    pub progress: SvkProgressFunction,
    /// First argument of `progress`.
    pub user: *mut c_void,
}

/// Figures of a mesh. Lengths are in the unit of the file.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkMeshInfo {
    /// sizeof(SvkMeshInfo)
    pub size: usize,
    /// Number of triangles.
    pub triangles: u64,
    /// Number of vertices.
    pub vertices: u64,
    /// Number of parts.
    pub parts: u64,
    /// Number of edges at holes and borders.
    pub border_edges: u64,
    /// 1 = y points up against gravity.
    pub upright: u32,
    /// 1 = the unit is a metre; 0 = that of the scene.
    pub metric: u32,
    /// Area of the surface, square units.
    pub area: f64,
    /// Side of a voxel.
    pub voxel: f64,
    /// Length by which the simplification moved 99.9 % of the surface at most.
    pub moved: f64,
}

/// Options of svk_scene_objects. Zero is the default of every field but `size`.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkObjectsOptions {
    /// sizeof(SvkObjectsOptions)
    pub size: usize,
    /// Names to choose from, one a line; NULL = those of the text model.
    pub vocabulary: *const c_char,
    /// Smallest share of the opacity of the scene that is a thing, up to 1; 0 = 0.001.
    pub min_share: f64,
    /// Format of the file of each thing, as of --format; NULL = "ply".
    pub format: *const c_char,
    /// SvkPieces: level of the files; objects.json lists all.
    pub pieces: u32,
    /// 1 = files keep the axes and the unit of the scene; otherwise they are upright and in metres,
    /// as far as the scene states them.
    pub raw: u32,
    /// 1 = replace ordinary files of the same names in the folder.
    pub replace: u64,
    /// Progress callback; may be NULL.
    pub progress: SvkProgressFunction,
    /// First argument of `progress`.
    pub user: *mut c_void,
}

/// An edit of a scene directory. Zero is the default of every field but `size`.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkEdit {
    /// sizeof(SvkEdit)
    pub size: usize,
    /// SvkOperation
    pub operation: u32,
    /// 1 = also edit where the selection is doubtful.
    pub force: u32,
    /// 1 = only select: nothing is changed, whether it is doubtful or not.
    pub dry_run: u32,
    /// SVK_OPERATION_FLOATERS: 1 = also splats on the surface of one photo that more photos look
    /// through.
    pub thorough: u32,
    /// Selection as of `splatvk edit`: words, ids of things ("id:o3"), ranges ("opacity<0.1",
    /// "size>5cm", "reliability<0.3", "seen<1"), the thing at a pixel of a photo ("at:PHOTO:X,Y"),
    /// an outline there ("in:PHOTO:X,Y X,Y X,Y"), joined with " + ", " - " or " & ". NULL with
    /// SVK_OPERATION_FLOATERS.
    pub selection: *const c_char,
    /// Words select more (above 0) or less (below 0), -1 to 1.
    pub grow: f64,
    /// SVK_OPERATION_RECOLOUR: sRGB colour, "#rrggbb" or "#rgb".
    pub colour: *const c_char,
    /// SVK_OPERATION_MOVE: displacement along the axes of the scene, scene units.
    pub displacement: [f64; 3],
    /// SVK_OPERATION_MOVE: a text instead of `displacement`, "0,-5cm,0", "up 5cm" or "down 5cm".
    /// NULL = `displacement`.
    pub by: *const c_char,
}

/// Outcome of an edit.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkEdited {
    /// sizeof(SvkEdited)
    pub size: usize,
    /// Number of selected splats.
    pub splats: u64,
    /// Their share of the opacity of the scene, 0 to 1.
    pub share: f64,
    /// Number of reasons why the selection may be wrong; svk_editor_doubts returns them.
    pub doubts: u64,
    /// Number of splats that a deletion took along: those behind the selected ones, which no photo
    /// shows.
    pub along: u64,
}
