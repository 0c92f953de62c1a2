//! Line plots as SVG and PNG, without fonts of the system.

use std::path::Path;
use std::sync::Once;

use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::{FontStyle, register_font};

/// An axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scale {
    /// Equal steps.
    Linear,
    /// Equal factors.
    Log,
}

/// How a line is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Style {
    /// A line with a mark at every point.
    Mark,
    /// A line without marks.
    Line,
    /// A line with an open mark at every point.
    Hollow,
    /// A dashed line.
    Dashed,
    /// Marks only.
    Points,
}

/// A line of a panel.
#[derive(Clone, Debug)]
pub struct Line {
    /// In the legend; empty: not in the legend.
    pub title: String,
    /// How it is drawn.
    pub style: Style,
    /// Index of the palette.
    pub colour: usize,
    /// Left to right.
    pub points: Vec<(f64, f64)>,
}

/// A pair of axes.
#[derive(Clone, Debug)]
pub struct Panel {
    /// Above it.
    pub title: String,
    /// With unit.
    pub x_label: String,
    /// With unit.
    pub y_label: String,
    /// Horizontal axis.
    pub x: Scale,
    /// Vertical axis.
    pub y: Scale,
    /// Limits; `None`: from the points.
    pub y_range: Option<(f64, f64)>,
    /// What is drawn.
    pub lines: Vec<Line>,
    /// With legend.
    pub legend: bool,
}

/// Panels in rows.
#[derive(Clone, Debug)]
pub struct Figure {
    /// Panels in a row.
    pub columns: usize,
    /// Row by row.
    pub panels: Vec<Panel>,
}

/// A picture that could not be drawn or written.
#[derive(Clone, Debug, thiserror::Error)]
#[error("picture '{name}': {reason}; is the folder writable?")]
pub struct PlotError {
    name: String,
    reason: String,
}

/// Told apart by people who do not see all colours. Source: Okabe and Ito, "Color Universal Design" (2008).
const PALETTE: [RGBColor; 8] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 86, 86),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(0, 0, 0),
];
const INK: RGBColor = RGBColor(23, 32, 43);
const GRID: RGBColor = RGBColor(222, 227, 233);
const FAINT: RGBColor = RGBColor(241, 243, 246);
const FONT: &str = "sans-serif";
/// Pixels of a panel in the PNG; the SVG has half as many units.
const PANEL: (u32, u32) = (1180, 900);

type PixelPath = PathElement<(i32, i32)>;

static FONT_READY: Once = Once::new();

/// Writes `name.svg` and `name.png` into `folder`.
///
/// # Errors
/// [`PlotError`] when a file cannot be written.
pub fn write(folder: &Path, name: &str, figure: &Figure) -> Result<(), PlotError> {
    FONT_READY.call_once(|| {
        // A font that does not load would leave the PNG without text; the check of the pictures would see it.
        let _ = register_font(FONT, FontStyle::Normal, epaint_default_fonts::UBUNTU_LIGHT);
    });
    let columns = figure.columns.max(1);
    let rows = figure.panels.len().div_ceil(columns);
    let size = (PANEL.0 * columns as u32, PANEL.1 * rows as u32);
    let failed = |reason: String| PlotError { name: name.to_owned(), reason };
    let png = folder.join(format!("{name}.png"));
    let svg = folder.join(format!("{name}.svg"));
    draw(BitMapBackend::new(&png, size).into_drawing_area(), figure, 2.0).map_err(failed)?;
    draw(SVGBackend::new(&svg, (size.0 / 2, size.1 / 2)).into_drawing_area(), figure, 1.0).map_err(failed)
}

fn draw<B: DrawingBackend>(area: DrawingArea<B, Shift>, figure: &Figure, zoom: f64) -> Result<(), String> {
    let text = |e: DrawingAreaErrorKind<B::ErrorType>| e.to_string();
    area.fill(&WHITE).map_err(text)?;
    let columns = figure.columns.max(1);
    let rows = figure.panels.len().div_ceil(columns);
    for (cell, panel) in area.split_evenly((rows, columns)).iter().zip(&figure.panels) {
        draw_panel(cell, panel, zoom).map_err(text)?;
    }
    area.present().map_err(text)
}

/// Axes are drawn in transformed coordinates (logarithms to base 10 where the scale is logarithmic): labels are then powers of ten.
fn draw_panel<B: DrawingBackend>(
    area: &DrawingArea<B, Shift>,
    panel: &Panel,
    zoom: f64,
) -> Result<(), DrawingAreaErrorKind<B::ErrorType>> {
    let px = |x: f64| (x * zoom).round() as i32;
    let at = |scale: Scale, x: f64| if scale == Scale::Log { x.log10() } else { x };
    let points: Vec<(f64, f64)> = panel
        .lines
        .iter()
        .flat_map(|line| line.points.iter().map(|&(x, y)| (at(panel.x, x), at(panel.y, y))))
        .filter(|(x, y)| x.is_finite() && y.is_finite())
        .collect();
    let (x_low, x_high) = span(points.iter().map(|p| p.0), panel.x, None);
    let y_range = panel.y_range.map(|(a, b)| (at(panel.y, a), at(panel.y, b)));
    let (y_low, y_high) = span(points.iter().map(|p| p.1), panel.y, y_range);
    let style = |size: f64| (FONT, px(size)).into_font().color(&INK);
    let mut chart = ChartBuilder::on(area)
        .margin(px(14.0))
        .caption(&panel.title, style(19.0))
        .x_label_area_size(px(48.0))
        .y_label_area_size(px(72.0))
        .build_cartesian_2d(x_low..x_high, y_low..y_high)?;
    let label = |scale: Scale| {
        move |x: &f64| match scale {
            Scale::Linear => trimmed(*x),
            Scale::Log => {
                // Labels at whole powers of ten; finer ticks of a short axis as plain numbers.
                if (x - x.round()).abs() < 1e-6 { power(x.round() as i32) } else { trimmed(10f64.powf(*x)) }
            }
        }
    };
    let (x_text, y_text) = (label(panel.x), label(panel.y));
    let count = |scale: Scale, low: f64, high: f64| match scale {
        Scale::Linear => 7,
        Scale::Log => ((high - low).ceil() as usize + 1).clamp(3, 9),
    };
    chart
        .configure_mesh()
        .axis_style(ShapeStyle::from(&INK).stroke_width(zoom as u32))
        .bold_line_style(ShapeStyle::from(&GRID).stroke_width(zoom as u32))
        .light_line_style(ShapeStyle::from(&FAINT).stroke_width(zoom as u32))
        .max_light_lines(if panel.x == Scale::Linear && panel.y == Scale::Linear { 2 } else { 1 })
        .x_labels(count(panel.x, x_low, x_high))
        .y_labels(count(panel.y, y_low, y_high))
        .x_label_formatter(&x_text)
        .y_label_formatter(&y_text)
        .x_desc(&panel.x_label)
        .y_desc(&panel.y_label)
        .label_style(style(14.5))
        .axis_desc_style(style(16.5))
        .draw()?;
    for line in &panel.lines {
        let colour = PALETTE[line.colour % PALETTE.len()];
        let stroke = ShapeStyle::from(&colour).stroke_width(px(2.0) as u32);
        let points: Vec<(f64, f64)> =
            line.points.iter().map(|&(x, y)| (at(panel.x, x), at(panel.y, y))).collect();
        let radius = px(3.8);
        let series = match line.style {
            Style::Mark => {
                chart.draw_series(points.iter().map(|&p| Circle::new(p, radius, colour.filled())))?;
                chart.draw_series(LineSeries::new(points, stroke))?
            }
            Style::Hollow => {
                let thin = ShapeStyle::from(&colour).stroke_width(px(1.4) as u32);
                chart.draw_series(DashedLineSeries::new(points.clone(), px(9.0), px(3.0), thin))?;
                chart.draw_series(points.iter().map(|&p| Circle::new(p, radius, WHITE.filled())))?;
                chart.draw_series(points.iter().map(|&p| Circle::new(p, radius, stroke)))?
            }
            Style::Line => chart.draw_series(LineSeries::new(points, stroke))?,
            Style::Dashed => chart.draw_series(DashedLineSeries::new(points, px(7.0), px(5.0), stroke))?,
            Style::Points => {
                let thick = ShapeStyle::from(&colour).stroke_width(px(2.0) as u32);
                chart.draw_series(points.iter().map(|&p| Cross::new(p, px(5.0), thick)))?
            }
        };
        if !line.title.is_empty() {
            let kind = line.style;
            series.label(&line.title).legend(move |at| {
                let (left, right, dot) = legend_parts(kind, colour, zoom);
                EmptyElement::at(at) + left + right + dot
            });
        }
    }
    if panel.legend {
        chart
            .configure_series_labels()
            .position(legend_place(&points, (x_low, x_high), (y_low, y_high)))
            .margin(px(10.0))
            .legend_area_size(px(34.0))
            .background_style(WHITE.mix(0.86))
            .border_style(ShapeStyle::from(&GRID).stroke_width(zoom as u32))
            .label_font(style(14.5))
            .draw()?;
    }
    Ok(())
}

/// The picture of a line in the legend as two strokes and a dot.
fn legend_parts(
    style: Style,
    colour: RGBColor,
    zoom: f64,
) -> (PixelPath, PixelPath, Circle<(i32, i32), i32>) {
    let px = |x: f64| (x * zoom).round() as i32;
    let stroke = ShapeStyle::from(&colour).stroke_width(px(2.0) as u32);
    let path = |from: (f64, f64), to: (f64, f64)| {
        PathElement::new(vec![(px(from.0), px(from.1)), (px(to.0), px(to.1))], stroke)
    };
    let none = Circle::new((px(13.0), 0), 0, TRANSPARENT);
    match style {
        Style::Mark => {
            let dot = Circle::new((px(13.0), 0), px(3.8), colour.filled());
            (path((0.0, 0.0), (13.0, 0.0)), path((13.0, 0.0), (26.0, 0.0)), dot)
        }
        Style::Hollow => {
            let dot = Circle::new((px(13.0), 0), px(3.8), stroke);
            (path((0.0, 0.0), (9.0, 0.0)), path((17.0, 0.0), (26.0, 0.0)), dot)
        }
        Style::Line => (path((0.0, 0.0), (13.0, 0.0)), path((13.0, 0.0), (26.0, 0.0)), none),
        Style::Dashed => (path((0.0, 0.0), (10.0, 0.0)), path((16.0, 0.0), (26.0, 0.0)), none),
        Style::Points => (path((8.0, -5.0), (18.0, 5.0)), path((8.0, 5.0), (18.0, -5.0)), none),
    }
}

/// Limits of an axis: with some room, logarithmic ones to whole decades if they span two or more.
fn span(values: impl Iterator<Item = f64>, scale: Scale, given: Option<(f64, f64)>) -> (f64, f64) {
    if let Some(range) = given {
        return range;
    }
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), x| (a.min(x), b.max(x)));
    if low > high {
        return (0.0, 1.0);
    }
    match scale {
        Scale::Log if high - low > 1.0 => ((low - 0.02).floor(), (high + 0.02).ceil()),
        Scale::Log => (low - 0.1, high + 0.1),
        Scale::Linear => {
            let room = 0.04 * (high - low).max(1e-12);
            (if low >= 0.0 && low < 0.2 * high { 0.0 } else { low - room }, high + room)
        }
    }
}

/// The corner with the fewest points.
fn legend_place(points: &[(f64, f64)], x: (f64, f64), y: (f64, f64)) -> SeriesLabelPosition {
    let corners = [
        (SeriesLabelPosition::UpperLeft, 0.0, 1.0),
        (SeriesLabelPosition::UpperRight, 1.0, 1.0),
        (SeriesLabelPosition::LowerLeft, 0.0, 0.0),
        (SeriesLabelPosition::LowerRight, 1.0, 0.0),
    ];
    let crowd = |cx: f64, cy: f64| {
        points
            .iter()
            .filter(|p| {
                let dx = ((p.0 - x.0) / (x.1 - x.0) - cx).abs();
                let dy = ((p.1 - y.0) / (y.1 - y.0) - cy).abs();
                dx < 0.5 && dy < 0.42
            })
            .count()
    };
    let mut best = (usize::MAX, SeriesLabelPosition::UpperLeft);
    for (place, cx, cy) in corners {
        let count = crowd(cx, cy);
        if count < best.0 {
            best = (count, place);
        }
    }
    best.1
}

/// A number without trailing zeros.
fn trimmed(x: f64) -> String {
    let text = if x.abs() >= 100.0 { format!("{x:.0}") } else { format!("{x:.3}") };
    let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    if text == "-0" { "0".into() } else { text.into() }
}

/// A power of ten with raised digits; small ones as they are.
fn power(exponent: i32) -> String {
    match exponent {
        0 => "1".into(),
        1 => "10".into(),
        2 => "100".into(),
        3 => "1000".into(),
        -1 => "0.1".into(),
        _ => {
            let raised = |c: char| match c {
                '-' => '⁻',
                '1' => '¹',
                '2' => '²',
                '3' => '³',
                digit => char::from_u32(0x2070 + digit as u32 - '0' as u32).unwrap_or(digit),
            };
            format!("10{}", exponent.to_string().chars().map(raised).collect::<String>())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels() {
        assert_eq!((power(-7), power(12), power(1)), ("10⁻⁷".into(), "10¹²".into(), "10".into()));
        assert_eq!((trimmed(0.25), trimmed(-0.0), trimmed(120.0)), ("0.25".into(), "0".into(), "120".into()));
    }
}
