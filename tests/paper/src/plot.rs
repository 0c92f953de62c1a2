//! Line plots as SVG and PNG, without fonts of the system.

use std::ops::Range;
use std::path::Path;
use std::sync::Once;

use plotters::coord::Shift;
use plotters::coord::ranged1d::{DefaultFormatting, KeyPointHint, Ranged};
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
    pub x_range: Option<(f64, f64)>,
    /// Limits; `None`: from the points.
    pub y_range: Option<(f64, f64)>,
    /// What is drawn.
    pub lines: Vec<Line>,
    /// Where the legend is.
    pub legend: Legend,
}

/// Where a legend is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Legend {
    /// In the corner with the fewest points.
    Corner,
    /// Beside the axes, where lines fill the panel.
    Beside,
    /// In the panel before.
    Before,
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
const FONT: &str = "sans-serif";
/// Units of the room for a legend beside the axes.
const LEGEND_WIDTH: f64 = 218.0;
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
    // What cannot be drawn: the logarithm of nothing, the time of what never succeeded.
    let drawn = |line: &Line| -> Vec<(f64, f64)> {
        let points = line.points.iter().map(|&(x, y)| (at(panel.x, x), at(panel.y, y)));
        points.filter(|(x, y)| x.is_finite() && y.is_finite()).collect()
    };
    let points: Vec<(f64, f64)> = panel.lines.iter().flat_map(drawn).collect();
    let x_range = panel.x_range.map(|(a, b)| (at(panel.x, a), at(panel.x, b)));
    let (x_low, x_high) = span(points.iter().map(|p| p.0), panel.x, x_range);
    let y_range = panel.y_range.map(|(a, b)| (at(panel.y, a), at(panel.y, b)));
    let (y_low, y_high) = span(points.iter().map(|p| p.1), panel.y, y_range);
    let style = |size: f64| (FONT, px(size)).into_font().color(&INK);
    let (area, beside) = match panel.legend {
        Legend::Corner | Legend::Before => (area.clone(), None),
        Legend::Beside => {
            let (left, right) = area.split_horizontally(area.dim_in_pixel().0 as i32 - px(LEGEND_WIDTH));
            (left, Some(right))
        }
    };
    let area = &area;
    let mut chart = ChartBuilder::on(area)
        .margin(px(14.0))
        .caption(&panel.title, style(19.0))
        .x_label_area_size(px(48.0))
        .y_label_area_size(px(72.0))
        .build_cartesian_2d(Axis::new(panel.x, x_low, x_high), Axis::new(panel.y, y_low, y_high))?;
    let label = |scale: Scale| {
        move |x: &f64| match scale {
            Scale::Linear => trimmed(*x),
            Scale::Log => power(*x),
        }
    };
    let (x_text, y_text) = (label(panel.x), label(panel.y));
    chart
        .configure_mesh()
        .axis_style(ShapeStyle::from(&INK).stroke_width(zoom as u32))
        .bold_line_style(ShapeStyle::from(&GRID).stroke_width(zoom as u32))
        .light_line_style(TRANSPARENT)
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
        let points = drawn(line);
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
    if let Some(beside) = beside {
        for (k, line) in panel.lines.iter().filter(|line| !line.title.is_empty()).enumerate() {
            let at = (px(8.0), px(60.0 + 26.0 * k as f64));
            let colour = PALETTE[line.colour % PALETTE.len()];
            let (left, right, dot) = legend_parts(line.style, colour, zoom);
            beside.draw(&(EmptyElement::at(at) + left + right + dot))?;
            beside.draw(&Text::new(line.title.clone(), (at.0 + px(34.0), at.1 - px(4.0)), style(14.5)))?;
        }
    } else if panel.legend == Legend::Corner {
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

/// An axis in transformed coordinates with its own choice of numbers.
#[derive(Clone, Debug)]
struct Axis {
    low: f64,
    high: f64,
    ticks: Vec<f64>,
}

impl Axis {
    fn new(scale: Scale, low: f64, high: f64) -> Self {
        Self { low, high, ticks: ticks(scale, low, high) }
    }
}

impl Ranged for Axis {
    type FormatOption = DefaultFormatting;
    type ValueType = f64;

    fn map(&self, value: &f64, limit: (i32, i32)) -> i32 {
        let share = (value - self.low) / (self.high - self.low);
        limit.0 + (share * f64::from(limit.1 - limit.0)).round() as i32
    }

    fn key_points<H: KeyPointHint>(&self, hint: H) -> Vec<f64> {
        if hint.weight().allow_light_points() { Vec::new() } else { self.ticks.clone() }
    }

    fn range(&self) -> Range<f64> {
        self.low..self.high
    }
}

/// Where an axis has its numbers: seven or fewer round ones; whole powers of ten, or 1, 2, 5 of every decade if there are few.
fn ticks(scale: Scale, low: f64, high: f64) -> Vec<f64> {
    let inside = |x: &f64| (low - 1e-9..=high + 1e-9).contains(x);
    match scale {
        Scale::Linear => {
            let rough = (high - low) / 7.0;
            let decade = 10f64.powf(rough.log10().floor());
            let step = [1.0, 2.0, 5.0, 10.0].map(|x| x * decade).into_iter().find(|s| *s >= rough);
            let step = step.unwrap_or(rough);
            let first = (low / step).ceil();
            (0..20).map(|k| (first + f64::from(k)) * step).filter(inside).collect()
        }
        Scale::Log => {
            let (first, last) = (low.floor() as i32, high.ceil() as i32);
            let decades = last - first;
            let stride = (decades / 9 + 1) as usize;
            let within: &[f64] = if high - low < 2.2 { &[1.0, 2.0, 5.0] } else { &[1.0] };
            let all = (first..=last).step_by(stride);
            all.flat_map(|e| within.iter().map(move |x| f64::from(e) + x.log10())).filter(inside).collect()
        }
    }
}

/// Ten to the power, short.
fn power(exponent: f64) -> String {
    let value = 10f64.powf(exponent);
    if (-2.5..4.5).contains(&exponent) {
        trimmed(value)
    } else if (exponent - exponent.round()).abs() < 1e-6 {
        format!("1e{}", exponent.round())
    } else {
        format!("{value:.0e}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_have_a_few_round_numbers() {
        let near =
            |a: Vec<f64>, b: &[f64]| a.len() == b.len() && a.iter().zip(b).all(|(x, y)| (x - y).abs() < 1e-9);
        assert!(near(ticks(Scale::Linear, 0.0, 62.0), &[0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0]));
        assert!(near(ticks(Scale::Log, -4.0, 0.0), &[-4.0, -3.0, -2.0, -1.0, 0.0]));
        assert!(near(ticks(Scale::Log, -0.1, 1.1), &[0.0, 2f64.log10(), 5f64.log10(), 1.0]));
        assert!(ticks(Scale::Log, -17.0, 3.0).len() <= 9);
    }

    #[test]
    fn what_is_not_finite_is_left_out() {
        let points =
            vec![(1.0, 0.1), (2.0, f64::INFINITY), (3.0, 0.0), (4.0, f64::NAN), (f64::INFINITY, 0.2)];
        let line = Line { title: "some fail".into(), colour: 0, style: Style::Mark, points };
        let panel = Panel {
            title: "failures".into(),
            x_label: "x".into(),
            y_label: "y".into(),
            x: Scale::Linear,
            y: Scale::Log,
            x_range: None,
            y_range: None,
            lines: vec![line],
            legend: Legend::Corner,
        };
        let folder = std::env::temp_dir().join(format!("delmpc-plot-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        write(&folder, "failures", &Figure { columns: 1, panels: vec![panel] }).unwrap();
        std::fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn labels() {
        assert_eq!((power(-7.0), power(12.0), power(1.0)), ("1e-7".into(), "1e12".into(), "10".into()));
        assert_eq!(power(0.5f64.log10()), "0.5");
        assert_eq!((trimmed(0.25), trimmed(-0.0), trimmed(120.0)), ("0.25".into(), "0".into(), "120".into()));
    }
}
