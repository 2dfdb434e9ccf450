//! Tiles of pixels.
use crate::gpu::NativeCall;
use crate::gpu::shaders::shared::layout::TILE;

pub(super) const EDGE: usize = TILE as usize;

/// A row of pixels of a tile.
pub(super) type Row = [f32; EDGE];
/// The pixels of a tile.
pub(super) type Plane = [Row; EDGE];

/// The first push constants of the passes over tile lists: rows of an image, and of tiles.
pub(super) struct TileRows {
    width: usize,
    /// First row of pixels of the planes, and their number.
    pub top: usize,
    rows: usize,
    /// First row of tiles of the dispatch, and of the lists.
    first_row: usize,
    list_row: usize,
    pub tiles_x: usize,
}

impl TileRows {
    pub fn of(call: &NativeCall) -> Result<TileRows, String> {
        let [width, top, rows, first_row, list_row, tiles_x] = call.words()?.map(|word| word as usize);
        Ok(TileRows { width, top, rows, first_row, list_row, tiles_x })
    }

    /// All rows of an image.
    pub fn of_image(width: usize, rows: usize, tiles_x: usize) -> TileRows {
        TileRows { width, top: 0, rows, first_row: 0, list_row: 0, tiles_x }
    }

    /// Pixels of the planes.
    pub fn pixels(&self) -> usize {
        self.width * self.rows
    }

    /// Tiles of a row of a dispatch.
    pub fn tiles(&self, groups: [u32; 3], row: usize) -> impl Iterator<Item = Tile> + '_ {
        let row = row + self.first_row;
        (0..groups[0] as usize).map(move |column| Tile {
            list: (row - self.list_row) * self.tiles_x + column,
            x: column * EDGE,
            y: row * EDGE,
            columns: (self.width - column * EDGE).min(EDGE),
            rows: (self.top + self.rows).saturating_sub(row * EDGE).min(EDGE),
        })
    }

    /// Place of the first pixel of a row of a tile in a plane.
    pub fn pixel(&self, tile: &Tile, row: usize) -> usize {
        (tile.y + row - self.top) * self.width + tile.x
    }
}

/// A tile, with the columns and rows that lie in the image.
pub(super) struct Tile {
    pub list: usize,
    pub x: usize,
    pub y: usize,
    pub columns: usize,
    pub rows: usize,
}

impl Tile {
    /// Its pixels before the first splat.
    pub fn pixels(&self) -> Pixels {
        let start = |x: usize, y: usize| if x < self.columns && y < self.rows { 1.0 } else { -1.0 };
        let t = std::array::from_fn(|y| std::array::from_fn(|x| start(x, y)));
        Pixels { open: (1 << self.rows) - 1, t }
    }
}

/// Pixels of a tile while splats cover them, nearest first.
pub(super) struct Pixels {
    /// A bit for each row with a pixel that has not stopped.
    pub open: u32,
    /// Transmittance, negative where a pixel has stopped and beyond the border.
    pub t: Plane,
}
