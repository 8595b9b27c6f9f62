//! A canvas of pixels with the few shapes that a plan is drawn with.

use tiny_skia::{
    Color, FillRule, LineCap, LineJoin, Paint, PathBuilder, Pixmap, Rect, Stroke, StrokeDash, Transform,
};

use super::text;

/// Opaque RGB.
pub type Rgb = [u8; 3];

/// The drawing area. Coordinates are pixels from the top-left corner.
pub struct Canvas(Pixmap);

impl Canvas {
    /// A white canvas; `None` for a size of zero or one beyond memory.
    pub fn new(width: u32, height: u32) -> Option<Self> {
        let mut pixmap = Pixmap::new(width, height)?;
        pixmap.fill(Color::WHITE);
        Some(Self(pixmap))
    }

    /// The PNG file.
    pub fn encode(&self) -> Result<Vec<u8>, String> {
        self.0.encode_png().map_err(|error| error.to_string())
    }

    /// A filled rectangle.
    pub fn fill_rect(&mut self, [left, top, right, bottom]: [f32; 4], colour: Rgb, alpha: f32) {
        if let Some(rect) = Rect::from_ltrb(left, top, right, bottom) {
            self.0.fill_rect(rect, &paint(colour, alpha), Transform::identity(), None);
        }
    }

    /// The outline of a rectangle, dashed with `dash` pixels where that is above 0.
    pub fn stroke_rect(&mut self, [left, top, right, bottom]: [f32; 4], pen: Pen) {
        let corners = [[left, top], [right, top], [right, bottom], [left, bottom], [left, top]];
        self.polylines(&[corners.to_vec()], pen);
    }

    /// Lines through points; all in one go, so that crossings are not darker.
    pub fn polylines(&mut self, lines: &[Vec<[f32; 2]>], pen: Pen) {
        let mut builder = PathBuilder::new();
        for line in lines.iter().filter(|line| line.len() > 1) {
            builder.move_to(line[0][0], line[0][1]);
            for &[x, y] in &line[1..] {
                builder.line_to(x, y);
            }
        }
        if let Some(path) = builder.finish() {
            let dash = StrokeDash::new(vec![pen.dash, pen.dash * 0.8], 0.0).filter(|_| pen.dash > 0.0);
            let (line_cap, line_join) = (LineCap::Round, LineJoin::Round);
            let stroke = Stroke { width: pen.width, dash, line_cap, line_join, ..Stroke::default() };
            self.0.stroke_path(&path, &paint(pen.colour, pen.alpha), &stroke, Transform::identity(), None);
        }
    }

    /// Filled discs.
    pub fn discs(&mut self, centres: &[[f32; 2]], radius: f32, colour: Rgb, alpha: f32) {
        let mut builder = PathBuilder::new();
        for &[x, y] in centres {
            builder.push_circle(x, y, radius);
        }
        if let Some(path) = builder.finish() {
            let paint = paint(colour, alpha);
            self.0.fill_path(&path, &paint, FillRule::Winding, Transform::identity(), None);
        }
    }

    /// Rings.
    pub fn rings(&mut self, centres: &[[f32; 2]], radius: f32, pen: Pen) {
        let mut builder = PathBuilder::new();
        for &[x, y] in centres {
            builder.push_circle(x, y, radius);
        }
        if let Some(path) = builder.finish() {
            let stroke = Stroke { width: pen.width, ..Stroke::default() };
            self.0.stroke_path(&path, &paint(pen.colour, pen.alpha), &stroke, Transform::identity(), None);
        }
    }

    /// Text with its baseline at `y`; `x` is its left end, centre or right end for `align` 0, 0.5 and 1.
    pub fn text(&mut self, text: &str, [x, y]: [f32; 2], height: f32, align: f32, colour: Rgb) {
        let x = x - align * text::width(text, height);
        if let Some(path) = text::strokes(text, x, y, height) {
            let (line_cap, line_join) = (LineCap::Round, LineJoin::Round);
            let stroke = Stroke { width: (height / 6.5).max(1.1), line_cap, line_join, ..Stroke::default() };
            self.0.stroke_path(&path, &paint(colour, 1.0), &stroke, Transform::identity(), None);
        }
    }
}

/// How a line looks.
#[derive(Clone, Copy, Debug)]
pub struct Pen {
    /// Colour.
    pub colour: Rgb,
    /// Opacity, 0 to 1.
    pub alpha: f32,
    /// Width, pixels.
    pub width: f32,
    /// Length of dashes, pixels; 0 for a solid line.
    pub dash: f32,
}

impl Pen {
    /// A solid, opaque line.
    pub fn solid(colour: Rgb, width: f32) -> Self {
        Self { colour, alpha: 1.0, width, dash: 0.0 }
    }
}

fn paint([r, g, b]: Rgb, alpha: f32) -> Paint<'static> {
    let mut paint = Paint { anti_alias: true, ..Paint::default() };
    paint.set_color_rgba8(r, g, b, (alpha * 255.0).round() as u8);
    paint
}
