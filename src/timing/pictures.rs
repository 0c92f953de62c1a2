//! Histograms of the report as pictures: PNG for papers and mails, SVG for everything else. Both are drawn by the same strokes.

use std::fmt::Write as _;
use std::path::Path;

use crate::output_file;
use crate::report::canvas::{Align, Canvas, Colour, Text};
use crate::report::colours::{DASH, GRID, INK, PALETTE, SOFT, WHITE};
use crate::timing::TimingReport;
use crate::timing::phases::{LoopFigures, Quantity};
use crate::verdict::Failure;

const SIZE: [f32; 2] = [1400.0, 620.0];
const LEFT: f32 = 118.0;
const RIGHT: f32 = 56.0;
const TOP: f32 = 124.0;
const BOTTOM: f32 = 70.0;

/// What a picture is drawn on.
trait Sheet {
    fn line(&mut self, points: &[[f32; 2]], with: Colour, width: f32, dash: Option<[f32; 2]>);
    fn text(&mut self, at: [f32; 2], align: Align, size: Text, text: &str, with: Colour);
}

impl Sheet for Canvas {
    fn line(&mut self, points: &[[f32; 2]], with: Colour, width: f32, dash: Option<[f32; 2]>) {
        Canvas::line(self, points.iter().copied(), with, width, dash);
    }

    fn text(&mut self, at: [f32; 2], align: Align, size: Text, text: &str, with: Colour) {
        // The letters of the canvas are those of English.
        Canvas::text(self, at, align, size, &text.replace('µ', "u"), with);
    }
}

/// An SVG file that grows.
struct Svg(String);

impl Svg {
    fn new() -> Self {
        let [width, height] = SIZE;
        Self(format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" font-family=\"sans-serif\">\n\
             <rect width=\"{width}\" height=\"{height}\" fill=\"#fff\"/>\n"
        ))
    }

    fn finish(mut self) -> String {
        self.0.push_str("</svg>\n");
        self.0
    }
}

fn hex([red, green, blue, _]: Colour) -> String {
    format!("#{red:02x}{green:02x}{blue:02x}")
}

impl Sheet for Svg {
    fn line(&mut self, points: &[[f32; 2]], with: Colour, width: f32, dash: Option<[f32; 2]>) {
        let points: Vec<String> = points.iter().map(|[x, y]| format!("{x:.1},{y:.1}")).collect();
        let dash = dash.map_or(String::new(), |[on, off]| format!(" stroke-dasharray=\"{on} {off}\""));
        let _ = writeln!(
            self.0,
            "<polyline points=\"{}\" fill=\"none\" stroke=\"{}\" stroke-width=\"{width}\" stroke-linejoin=\"round\"{dash}/>",
            points.join(" "),
            hex(with)
        );
    }

    fn text(&mut self, [x, y]: [f32; 2], align: Align, size: Text, text: &str, with: Colour) {
        let anchor = match align {
            Align::Left => "start",
            Align::Centre => "middle",
            Align::Right => "end",
        };
        let (size, weight) = match size {
            Text::Small => (19, "normal"),
            Text::Title => (24, "bold"),
        };
        let text = text.replace('&', "&amp;").replace('<', "&lt;");
        let _ = writeln!(
            self.0,
            "<text x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"{anchor}\" font-size=\"{size}\" font-weight=\"{weight}\" \
             fill=\"{}\">{text}</text>",
            y + 0.35 * size as f32,
            hex(with)
        );
    }
}

/// One curve of a picture.
struct Curve<'a> {
    name: String,
    quantity: &'a Quantity,
    dashed: bool,
}

/// A picture: histograms over the logarithm of time.
struct Picture<'a> {
    file: &'static str,
    title: String,
    curves: Vec<Curve<'a>>,
    /// A moment of interest with its name (s).
    mark: Option<(f64, &'static str)>,
}

/// Writes all pictures into a folder.
///
/// # Errors
/// When a file cannot be written.
pub fn write(report: &TimingReport, folder: &Path) -> Result<(), Failure> {
    for picture in pictures(report) {
        let mut canvas = Canvas::new(SIZE[0] as u32, SIZE[1] as u32, WHITE).map_err(Failure::fault)?;
        picture.draw(&mut canvas);
        let mut svg = Svg::new();
        picture.draw(&mut svg);
        for (suffix, content) in [("png", canvas.to_png()), ("svg", svg.finish().into_bytes())] {
            let file = folder.join(format!("{}.{suffix}", picture.file));
            output_file::write(&file, content)
                .map_err(|error| Failure::Fault(format!("{}: {error}", file.display())))?;
        }
    }
    Ok(())
}

fn pictures(report: &TimingReport) -> Vec<Picture<'_>> {
    let of_loops = |keys: &[(&str, &str)]| {
        let mut curves = Vec::new();
        for figures in &report.loops {
            for (key, name) in keys {
                if let Some(quantity) = named(figures, key) {
                    let name = if figures.loaded { format!("{name}, co-load") } else { (*name).to_owned() };
                    curves.push(Curve { name, quantity, dashed: figures.loaded });
                }
            }
        }
        curves
    };
    let idle = report.idle_floor.iter().filter(|floor| floor.core == report.cores[1]);
    let floor = idle.map(|floor| Curve {
        name: if floor.loaded { "idle thread, co-load".to_owned() } else { "idle thread".to_owned() },
        quantity: &floor.wake_up,
        dashed: floor.loaded,
    });
    let mut list = vec![
        Picture {
            file: "wake_up",
            title: "Wake-up latency on the controller's core, part of all".to_owned(),
            curves: floor.chain(of_loops(&[("wake_up", "controller")])).collect(),
            mark: None,
        },
        Picture {
            file: "cycle",
            title: "Control cycle from waking up to its command sent, part of all".to_owned(),
            curves: of_loops(&[("cycle", "by the clock"), ("cycle_own", "own time")]),
            mark: Some((report.period_s, "period")),
        },
        Picture {
            file: "latency",
            title: "From one process to the other, part of all".to_owned(),
            curves: of_loops(&[("age", "state measured to its command"), ("plant_step", "plant step")]),
            mark: None,
        },
    ];
    if let Some(figures) = report.loops.first() {
        let stages = ["statein", "linearize", "riccati", "qp", "publish"];
        let curve = |stage: &str| {
            let quantity = named(figures, &format!("stage_{stage}"))?;
            let name = quantity.name.trim_start_matches("controller: ").to_owned();
            Some(Curve { name, quantity, dashed: false })
        };
        list.push(Picture {
            file: "stages",
            title: "Stages of the control cycle, part of all".to_owned(),
            curves: stages.into_iter().filter_map(curve).collect(),
            mark: None,
        });
    }
    if let Some(transport) = &report.transport {
        let curve = |name: &str, quantity| Curve { name: name.to_owned(), quantity, dashed: false };
        list.push(Picture {
            file: "transport",
            title: "Round trip between two processes that poll, part of all".to_owned(),
            curves: vec![
                curve("flag", &transport.flag_round_trip),
                curve("state and state", &transport.state_round_trip),
                curve("state and command", &transport.command_round_trip),
            ],
            mark: None,
        });
    }
    list
}

fn named<'a>(figures: &'a LoopFigures, key: &str) -> Option<&'a Quantity> {
    figures.quantities.iter().find(|quantity| quantity.key == key)
}

impl Picture<'_> {
    fn draw(&self, sheet: &mut impl Sheet) {
        let bars = || self.curves.iter().flat_map(|curve| &curve.quantity.bars);
        let shortest = bars().map(|bar| bar.from_s).fold(f64::INFINITY, f64::min).clamp(1e-7, 1.0);
        let longest = bars().map(|bar| bar.to_s).fold(0.0, f64::max);
        let longest = longest.max(self.mark.map_or(0.0, |(time, _)| time)).max(10.0 * shortest);
        let x = [shortest.log10().floor(), longest.log10().ceil()];
        let least = self
            .curves
            .iter()
            .filter_map(|curve| curve.quantity.figures.map(|figures| 1.0 / figures.count.max(1) as f64));
        let y = [least.fold(0.1, f64::min).log10().floor(), 0.0];
        let (right, bottom) = (SIZE[0] - RIGHT, SIZE[1] - BOTTOM);
        let place_x = |time: f64| {
            LEFT + (right - LEFT) * ((time.log10() - x[0]) / (x[1] - x[0])).clamp(0.0, 1.0) as f32
        };
        let place_y = |part: f64| {
            bottom - (bottom - TOP) * ((part.log10() - y[0]) / (y[1] - y[0])).clamp(0.0, 1.0) as f32
        };

        sheet.text([LEFT, 30.0], Align::Left, Text::Title, &self.title, INK);
        for power in x[0] as i32..=x[1] as i32 {
            let at = place_x(10_f64.powi(power));
            sheet.line(&[[at, TOP], [at, bottom]], GRID, 1.5, None);
            sheet.text([at, bottom + 24.0], Align::Centre, Text::Small, &time_label(power), SOFT);
        }
        for power in y[0] as i32..=0 {
            let at = place_y(10_f64.powi(power));
            sheet.line(&[[LEFT, at], [right, at]], GRID, 1.5, None);
            let percent = 10_f64.powi(power + 2);
            let label = if power >= -2 {
                format!("{percent:.0} %")
            } else {
                format!("{percent:.*} %", (-2 - power) as usize)
            };
            sheet.text([LEFT - 12.0, at], Align::Right, Text::Small, &label, SOFT);
        }
        if let Some((time, name)) = self.mark {
            let at = place_x(time);
            sheet.line(&[[at, TOP], [at, bottom]], INK, 2.0, None);
            sheet.text([at + 8.0, TOP + 14.0], Align::Left, Text::Small, name, INK);
        }
        let mut legend = [LEFT, 64.0];
        for (index, curve) in self.curves.iter().enumerate() {
            let colour = PALETTE[index % PALETTE.len()];
            let dash = if curve.dashed { DASH } else { None };
            let width = 40.0 + Canvas::text_width(Text::Small, &curve.name) + 34.0;
            if legend[0] + width > right {
                legend = [LEFT, legend[1] + 30.0];
            }
            let [left, line] = legend;
            sheet.line(&[[left, line], [left + 30.0, line]], colour, 4.0, dash);
            sheet.text([left + 40.0, line], Align::Left, Text::Small, &curve.name, SOFT);
            legend[0] += width;
            let all = curve.quantity.figures.map_or(1, |figures| figures.count).max(1) as f64;
            let mut points: Vec<[f32; 2]> = Vec::new();
            for bar in &curve.quantity.bars {
                let (from, to) = (place_x(bar.from_s.max(1e-9)), place_x(bar.to_s));
                // Down to the floor where bars are missing.
                match points.last() {
                    Some(&[last, _]) if (last - from).abs() < 0.5 => {}
                    Some(&[last, _]) => points.extend([[last, bottom], [from, bottom]]),
                    None => points.push([from, bottom]),
                }
                let height = place_y(bar.count as f64 / all);
                points.extend([[from, height], [to, height]]);
            }
            if let Some(&[last, _]) = points.last() {
                points.push([last, bottom]);
            }
            sheet.line(&points, colour, 3.0, dash);
        }
    }
}

/// A power of ten of seconds.
fn time_label(power: i32) -> String {
    match power {
        ..=-7 => format!("{:.0} ns", 10_f64.powi(power + 9)),
        -6..=-4 => format!("{:.0} µs", 10_f64.powi(power + 6)),
        -3..=-1 => format!("{:.0} ms", 10_f64.powi(power + 3)),
        _ => format!("{:.0} s", 10_f64.powi(power)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::timing::figures::Times;

    #[test]
    fn a_curve_is_drawn_from_the_floor_to_the_floor() {
        let times = Times::of([10_000, 10_500, 2_000_000]);
        let quantity = Quantity {
            key: "k".to_owned(),
            name: "n".to_owned(),
            figures: times.figures(),
            bars: times.bars(),
        };
        let curves = vec![Curve { name: "a & b".to_owned(), quantity: &quantity, dashed: false }];
        let picture = Picture { file: "f", title: "t".to_owned(), curves, mark: Some((5e-3, "period")) };
        let mut svg = Svg::new();
        picture.draw(&mut svg);
        let text = svg.finish();
        assert!(text.contains("a &amp; b") && text.ends_with("</svg>\n"));
        let line = text.lines().find(|line| line.contains("stroke-width=\"3\"")).unwrap();
        let heights: Vec<&str> =
            line.split('"').nth(1).unwrap().split(' ').map(|p| p.split_once(',').unwrap().1).collect();
        assert_eq!(heights.first(), heights.last());
        assert!(heights.len() >= 8, "two bars with a gap: {heights:?}");
    }

    #[test]
    fn times_have_units() {
        assert_eq!(
            [-8, -6, -4, -3, -1, 0].map(time_label),
            ["10 ns", "1 µs", "100 µs", "1 ms", "100 ms", "1 s"]
        );
    }
}
