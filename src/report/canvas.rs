//! A sheet of pixels with lines, areas and words, and how it becomes a PNG file.

use miniz_oxide::deflate::compress_to_vec_zlib;
use noto_sans_mono_bitmap::{FontWeight, RasterHeight, get_raster, get_raster_width};
use tiny_skia::{
    Color, FillRule, LineCap, LineJoin, Paint, PathBuilder, Pixmap, PremultipliedColorU8, Rect, Stroke,
    StrokeDash, Transform,
};

/// Effort of the compression: beyond it files hardly become smaller.
const COMPRESSION: u8 = 6;
/// The letters are fixed-width pictures; a little closer together they read as text.
const LETTER_SPACING: f32 = 0.92;

/// Red, green, blue, and how much it covers (255: all).
pub type Colour = [u8; 4];

/// Where a text is relative to its point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Align {
    /// Begins there.
    Left,
    /// Has its middle there.
    Centre,
    /// Ends there.
    Right,
}

/// How large letters are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Text {
    /// Numbers at axes.
    Small,
    /// Titles.
    Title,
}

/// A sheet.
#[derive(Debug, Clone)]
pub struct Canvas {
    pixels: Pixmap,
}

/// Why there is no picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum CanvasError {
    /// Nothing to draw on.
    #[error("a picture needs a width and a height")]
    Empty,
}

impl Canvas {
    /// A sheet of one colour.
    ///
    /// # Errors
    /// Without width or height.
    pub fn new(width: u32, height: u32, background: Colour) -> Result<Self, CanvasError> {
        let mut pixels = Pixmap::new(width, height).ok_or(CanvasError::Empty)?;
        pixels.fill(colour(background));
        Ok(Self { pixels })
    }

    /// A line through points, broken where a point is no number. `dash`: lengths of line and gap.
    pub fn line(
        &mut self,
        points: impl IntoIterator<Item = [f32; 2]>,
        with: Colour,
        width: f32,
        dash: Option<[f32; 2]>,
    ) {
        let mut path = PathBuilder::new();
        let mut open = false;
        for [x, y] in points {
            match (x.is_finite() && y.is_finite(), open) {
                (false, _) => open = false,
                (true, true) => path.line_to(x, y),
                (true, false) => {
                    path.move_to(x, y);
                    open = true;
                }
            }
        }
        let Some(path) = path.finish() else { return };
        let dash = dash.and_then(|dash| StrokeDash::new(dash.to_vec(), 0.0));
        let stroke =
            Stroke { width, line_cap: LineCap::Round, line_join: LineJoin::Round, dash, ..Stroke::default() };
        self.pixels.stroke_path(&path, &paint(with), &stroke, Transform::identity(), None);
    }

    /// The inside of a polygon.
    pub fn polygon(&mut self, points: impl IntoIterator<Item = [f32; 2]>, with: Colour) {
        let mut path = PathBuilder::new();
        for [x, y] in points {
            if path.is_empty() { path.move_to(x, y) } else { path.line_to(x, y) }
        }
        path.close();
        if let Some(path) = path.finish() {
            self.pixels.fill_path(&path, &paint(with), FillRule::Winding, Transform::identity(), None);
        }
    }

    /// A rectangle from one corner to the opposite one.
    pub fn rectangle(&mut self, [x0, y0]: [f32; 2], [x1, y1]: [f32; 2], with: Colour) {
        if let Some(rectangle) = Rect::from_ltrb(x0.min(x1), y0.min(y1), x0.max(x1), y0.max(y1)) {
            self.pixels.fill_rect(rectangle, &paint(with), Transform::identity(), None);
        }
    }

    /// A disc.
    pub fn disc(&mut self, [x, y]: [f32; 2], radius: f32, with: Colour) {
        if let Some(path) = PathBuilder::from_circle(x, y, radius) {
            self.pixels.fill_path(&path, &paint(with), FillRule::Winding, Transform::identity(), None);
        }
    }

    /// A text whose middle is at the height of a point. Signs that are not in the font are left out.
    pub fn text(&mut self, [x, y]: [f32; 2], align: Align, size: Text, text: &str, with: Colour) {
        let (weight, height) = font(size);
        let advance = get_raster_width(weight, height) as f32 * LETTER_SPACING;
        let width = advance * text.chars().count() as f32;
        let mut left = match align {
            Align::Left => x,
            Align::Centre => x - width / 2.0,
            Align::Right => x - width,
        };
        let top = (y - height.val() as f32 / 2.0).round();
        for letter in text.chars() {
            if let Some(raster) = get_raster(letter, weight, height) {
                for (row, line) in raster.raster().iter().enumerate() {
                    for (column, &cover) in line.iter().enumerate() {
                        self.cover(left.round() as i64 + column as i64, top as i64 + row as i64, cover, with);
                    }
                }
            }
            left += advance;
        }
    }

    /// Width of a text in pixels.
    pub fn text_width(size: Text, text: &str) -> f32 {
        let (weight, height) = font(size);
        get_raster_width(weight, height) as f32 * LETTER_SPACING * text.chars().count() as f32
    }

    fn cover(&mut self, x: i64, y: i64, cover: u8, [red, green, blue, _]: Colour) {
        let (width, height) = (i64::from(self.pixels.width()), i64::from(self.pixels.height()));
        if cover == 0 || !(0..width).contains(&x) || !(0..height).contains(&y) {
            return;
        }
        let Some(pixel) = self.pixels.pixels_mut().get_mut((y * width + x) as usize) else { return };
        let mix = |under: u8, over: u8| {
            let (under, over, cover) = (u32::from(under), u32::from(over), u32::from(cover));
            ((under * (255 - cover) + over * cover + 127) / 255) as u8
        };
        let (red, green, blue) = (mix(pixel.red(), red), mix(pixel.green(), green), mix(pixel.blue(), blue));
        // The sheet is opaque, so colours are what they are.
        if let Some(mixed) = PremultipliedColorU8::from_rgba(red, green, blue, 255) {
            *pixel = mixed;
        }
    }

    /// The file. Source: PNG specification, third edition; every line is stored as the difference from the line above, which suits plots.
    pub fn to_png(&self) -> Vec<u8> {
        let (width, height) = (self.pixels.width(), self.pixels.height());
        let line = 3 * width as usize;
        let (mut above, mut now) = (vec![0_u8; line], vec![0_u8; line]);
        let mut lines = Vec::with_capacity((line + 1) * height as usize);
        for row in self.pixels.pixels().chunks(width as usize) {
            for (bytes, pixel) in now.chunks_mut(3).zip(row) {
                bytes.copy_from_slice(&[pixel.red(), pixel.green(), pixel.blue()]);
            }
            lines.push(2); // filter "up"
            lines.extend(now.iter().zip(&above).map(|(now, above)| now.wrapping_sub(*above)));
            std::mem::swap(&mut above, &mut now);
        }
        let mut header = [0, 0, 0, 0, 0, 0, 0, 0, 8, 2, 0, 0, 0]; // 8 bits of red, green, blue
        header[..4].copy_from_slice(&width.to_be_bytes());
        header[4..8].copy_from_slice(&height.to_be_bytes());
        let mut file = b"\x89PNG\r\n\x1a\n".to_vec();
        chunk(&mut file, *b"IHDR", &header);
        chunk(&mut file, *b"IDAT", &compress_to_vec_zlib(&lines, COMPRESSION));
        chunk(&mut file, *b"IEND", &[]);
        file
    }
}

fn chunk(file: &mut Vec<u8>, kind: [u8; 4], content: &[u8]) {
    file.extend((content.len() as u32).to_be_bytes());
    let begin = file.len();
    file.extend(kind);
    file.extend(content);
    let check = crc32fast::hash(&file[begin..]);
    file.extend(check.to_be_bytes());
}

fn font(size: Text) -> (FontWeight, RasterHeight) {
    match size {
        Text::Small => (FontWeight::Regular, RasterHeight::Size20),
        Text::Title => (FontWeight::Bold, RasterHeight::Size24),
    }
}

fn colour([red, green, blue, cover]: Colour) -> Color {
    Color::from_rgba8(red, green, blue, cover)
}

fn paint(with: Colour) -> Paint<'static> {
    let mut paint = Paint { anti_alias: true, ..Paint::default() };
    paint.set_color(colour(with));
    paint
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_is_a_png_file_with_its_pixels() {
        let mut canvas = Canvas::new(5, 3, [255, 255, 255, 255]).unwrap();
        canvas.rectangle([0.0, 0.0], [2.0, 3.0], [255, 0, 0, 255]);
        let file = canvas.to_png();
        assert_eq!(&file[..8], b"\x89PNG\r\n\x1a\n");
        assert_eq!(&file[16..24], &[0, 0, 0, 5, 0, 0, 0, 3]);
        let length = u32::from_be_bytes(file[33..37].try_into().unwrap()) as usize;
        let lines = miniz_oxide::inflate::decompress_to_vec_zlib(&file[41..41 + length]).unwrap();
        assert_eq!(lines.len(), 3 * (1 + 15));
        assert_eq!(&lines[..10], &[2, 255, 0, 0, 255, 0, 0, 255, 255, 255]);
        assert!(lines[17..32].iter().all(|&byte| byte == 0), "the second line is like the first");
        assert!(Canvas::new(0, 3, [0; 4]).is_err());
    }
}
