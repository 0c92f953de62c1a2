//! The key plots as pictures, for papers, issues and mails.

use delmpc_scenario::Clock;

use crate::report::canvas::{Align, Canvas, CanvasError, Colour, Text};
use crate::report::colours::{DASH, GRID, INK, PALETTE, SOFT, WHITE};
use crate::report::recording::{Column, Recording, Table};
use crate::setup::Setup;

const SIZE: [u32; 2] = [1400, 560];
const LEFT: f32 = 118.0;
const RIGHT: f32 = 28.0;
const TOP: f32 = 92.0;
const BOTTOM: f32 = 66.0;

const OUTSIDE: Colour = [213, 94, 0, 26];
const REACH: Colour = [0, 158, 115, 22];
const HOLD: Colour = [0, 158, 115, 44];
const PUSH: Colour = [213, 94, 0, 60];
/// Joints drawn by their own lines: those that use most of their limits.
const JOINTS: usize = 5;

/// All pictures with their file names.
///
/// # Errors
/// None in practice: the sheets have a size.
pub fn all(setup: &Setup, recording: &Recording) -> Result<Vec<(&'static str, Canvas)>, CanvasError> {
    let mut list = vec![
        ("com.png", mass_centre(setup, recording)?),
        ("torque.png", torques(setup, recording)?),
        ("constraints.png", constraints(setup, recording)?),
    ];
    let stance = setup.robot.sole(setup.scenario.robot.stance.first());
    // A foot that is a point has its pressure point there.
    if let Some(sole) = stance.filter(|sole| sole.polygon.len() >= 3) {
        let polygon: Vec<[f64; 2]> = sole.polygon.iter().map(|corner| (*corner).into()).collect();
        list.push(("pressure_x.png", pressure(setup, recording, &polygon, 0)?));
        list.push(("pressure_y.png", pressure(setup, recording, &polygon, 1)?));
        list.push(("sole.png", sole_from_above(setup, recording, &polygon)?));
    }
    if setup.scenario.reach.is_some() {
        list.push(("hand.png", hand(setup, recording)?));
    }
    if setup.scenario.clock == Clock::Realtime {
        list.push(("cycle_time.png", cycle_time(setup, recording)?));
    }
    Ok(list)
}

/// How a value becomes a height.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Scale {
    Linear,
    Logarithmic,
}

/// A sheet with axes.
struct Panel {
    canvas: Canvas,
    x: [f64; 2],
    y: [f64; 2],
    scale: Scale,
}

impl Panel {
    /// With the events of the run behind, and a legend above.
    fn new(
        setup: &Setup,
        recording: &Recording,
        title: &str,
        legend: &[(&str, Colour)],
        y: [f64; 2],
        scale: Scale,
    ) -> Result<Self, CanvasError> {
        let time = &recording.frames["time"];
        let x = [time.at(0, 0), time.at(time.rows().saturating_sub(1), 0).max(time.at(0, 0) + 1e-3)];
        let mut panel = Self { canvas: Canvas::new(SIZE[0], SIZE[1], WHITE)?, x, y, scale };
        panel.canvas.text([LEFT, 30.0], Align::Left, Text::Title, title, INK);
        let mut left = LEFT;
        for (name, colour) in legend {
            panel.canvas.line([[left, 64.0], [left + 30.0, 64.0]], *colour, 5.0, None);
            panel.canvas.text([left + 40.0, 64.0], Align::Left, Text::Small, name, SOFT);
            left += 40.0 + Canvas::text_width(Text::Small, name) + 34.0;
        }
        let scenario = &setup.scenario;
        if let Some(reach) = &scenario.reach {
            let deadline_s = reach.start_s + reach.deadline_s;
            panel.shade_time(reach.start_s, deadline_s, REACH);
            panel.shade_time(deadline_s, deadline_s + reach.hold_s, HOLD);
        }
        for push in scenario.push.iter().filter(|push| push.impulse_ns > 0.0) {
            panel.shade_time(push.start_s, push.start_s + push.duration_s, PUSH);
        }
        panel.axes();
        Ok(panel)
    }

    fn axes(&mut self) {
        let [left, right, top, bottom] = self.frame();
        for time in ticks(self.x, 10.0) {
            let x = self.place_x(time);
            self.canvas.line([[x, top], [x, bottom]], GRID, 1.5, None);
            self.canvas.text([x, bottom + 22.0], Align::Centre, Text::Small, &label(time), SOFT);
        }
        self.canvas.text([right, bottom + 48.0], Align::Right, Text::Small, "time in s", SOFT);
        let levels = match self.scale {
            Scale::Linear => ticks(self.y, 7.0),
            Scale::Logarithmic => {
                let decades = self.y[0].log10().ceil() as i32..=self.y[1].log10().floor() as i32;
                decades.map(|power| 10_f64.powi(power)).collect()
            }
        };
        for value in levels {
            let y = self.place_y(value);
            self.canvas.line([[left, y], [right, y]], GRID, 1.5, None);
            self.canvas.text([left - 12.0, y], Align::Right, Text::Small, &label(value), SOFT);
        }
    }

    /// Left, right, top, bottom.
    fn frame(&self) -> [f32; 4] {
        [LEFT, SIZE[0] as f32 - RIGHT, TOP, SIZE[1] as f32 - BOTTOM]
    }

    fn place_x(&self, time: f64) -> f32 {
        let [left, right, ..] = self.frame();
        left + (right - left) * ((time - self.x[0]) / (self.x[1] - self.x[0])) as f32
    }

    fn place_y(&self, value: f64) -> f32 {
        let [.., top, bottom] = self.frame();
        let [low, high] = self.y;
        let part = match self.scale {
            Scale::Linear => (value - low) / (high - low),
            Scale::Logarithmic => (value.max(low) / low).ln() / (high / low).ln(),
        };
        // What is beyond the axis stays at its edge.
        bottom - (bottom - top) * if part.is_nan() { f32::NAN } else { part.clamp(0.0, 1.0) as f32 }
    }

    fn shade_time(&mut self, from: f64, to: f64, with: Colour) {
        let [left, right, top, bottom] = self.frame();
        let (from, to) = (self.place_x(from).clamp(left, right), self.place_x(to).clamp(left, right));
        if to > from {
            self.canvas.rectangle([from, top], [to.max(from + 2.0), bottom], with);
        }
    }

    fn level(&mut self, value: f64, dash: Option<[f32; 2]>) {
        let [left, right, ..] = self.frame();
        let y = self.place_y(value);
        self.canvas.line([[left, y], [right, y]], INK, 2.0, dash);
    }

    fn rows(&mut self, table: &Table, with: Colour, dash: Option<[f32; 2]>, value: impl Fn(usize) -> f64) {
        let time = &table["time"];
        let points: Vec<[f32; 2]> =
            (0..time.rows()).map(|row| [self.place_x(time.at(row, 0)), self.place_y(value(row))]).collect();
        self.canvas.line(points, with, 3.0, dash);
    }
}

fn mass_centre(setup: &Setup, recording: &Recording) -> Result<Canvas, CanvasError> {
    let com = &recording.frames["com"];
    let away = |row: usize, axis: usize| 1e3 * (com.at(row, axis) - com.at(0, axis));
    let values = (0..com.rows())
        .flat_map(|row| (0..3).map(move |axis| (row, axis)))
        .map(|(row, axis)| away(row, axis));
    let legend = [("x forward", PALETTE[0]), ("y left", PALETTE[1]), ("z up", PALETTE[2])];
    let title = "Mass centre, mm from its start";
    let mut panel = Panel::new(setup, recording, title, &legend, span(values, [-5.0, 5.0]), Scale::Linear)?;
    for (axis, (_, colour)) in legend.into_iter().enumerate() {
        panel.rows(&recording.frames, colour, None, |row| away(row, axis));
    }
    Ok(panel.canvas)
}

fn pressure(
    setup: &Setup,
    recording: &Recording,
    polygon: &[[f64; 2]],
    axis: usize,
) -> Result<Canvas, CanvasError> {
    let corners = polygon.iter().map(|corner| 1e3 * corner[axis]);
    let edges = [corners.clone().fold(f64::INFINITY, f64::min), corners.fold(f64::NEG_INFINITY, f64::max)];
    let room = 0.12 * (edges[1] - edges[0]);
    let title =
        ["Pressure point forward, mm in the sole", "Pressure point to the left, mm in the sole"][axis];
    let legend = [("pressure point", PALETTE[0]), ("capture point", PALETTE[3]), ("edge of the sole", INK)];
    let y = [edges[0] - room, edges[1] + room];
    let mut panel = Panel::new(setup, recording, title, &legend, y, Scale::Linear)?;
    let [left, right, top, bottom] = panel.frame();
    let (low, high) = (panel.place_y(edges[0]), panel.place_y(edges[1]));
    panel.canvas.rectangle([left, top], [right, high], OUTSIDE);
    panel.canvas.rectangle([left, low], [right, bottom], OUTSIDE);
    edges.iter().for_each(|&edge| panel.level(edge, None));
    let margin = 1e3 * setup.scenario.controller.constraints.cop_margin_m;
    if margin > 0.0 {
        panel.level(edges[0] + margin, DASH);
        panel.level(edges[1] - margin, DASH);
    }
    let (com, velocity) = (&recording.frames["com"], &recording.frames["com_velocity"]);
    let gravity = setup.robot.tree.gravity_w().norm();
    let capture = |row: usize| {
        1e3 * (com.at(row, axis) + velocity.at(row, axis) * (com.at(row, 2).max(0.05) / gravity).sqrt())
    };
    panel.rows(&recording.frames, PALETTE[3], DASH, capture);
    let column = |name: &str| &recording.frames[name];
    for name in ["pressure_low", "pressure_high", "pressure"] {
        panel.rows(&recording.frames, PALETTE[0], None, |row| 1e3 * column(name).at(row, axis));
    }
    Ok(panel.canvas)
}

fn hand(setup: &Setup, recording: &Recording) -> Result<Canvas, CanvasError> {
    let error = &recording.frames["hand_error"];
    let millimetres = |row: usize| 1e3 * error.at(row, 0);
    let limit = 1e3 * setup.scenario.success.hand_error_at_deadline_m;
    let values = || (0..error.rows()).map(millimetres).filter(|value| value.is_finite());
    let low = values().fold(limit, f64::min).max(0.1).log10().floor();
    let high = values().fold(limit, f64::max).log10().ceil();
    let legend = [("distance", PALETTE[0]), ("allowed at the deadline", INK)];
    let y = [10_f64.powf(low), 10_f64.powf(high)];
    let mut panel = Panel::new(setup, recording, "Hand to ball, mm", &legend, y, Scale::Logarithmic)?;
    panel.level(limit, DASH);
    panel.rows(&recording.frames, PALETTE[0], None, millimetres);
    Ok(panel.canvas)
}

fn torques(setup: &Setup, recording: &Recording) -> Result<Canvas, CanvasError> {
    let torque = &recording.frames["torque"];
    let share = |row: usize, joint: usize| 100.0 * torque.at(row, joint) / setup.robot.limits[joint].effort;
    let most = |joint: usize| (0..torque.rows()).map(|row| share(row, joint).abs()).fold(0.0, f64::max);
    let mut joints: Vec<(usize, f64)> = (0..torque.width).map(|joint| (joint, most(joint))).collect();
    joints.sort_by(|a, b| b.1.total_cmp(&a.1));
    joints.truncate(JOINTS);
    let names = joints
        .iter()
        .zip(PALETTE)
        .map(|(&(joint, _), colour)| (setup.robot.joint_names[joint].as_str(), colour));
    let legend: Vec<(&str, Colour)> = names.collect();
    let title = "Torques, % of the limit: the joints that use most of it";
    let highest = joints.first().map_or(0.0, |joint| joint.1).max(100.0) * 1.08;
    let mut panel = Panel::new(setup, recording, title, &legend, [-highest, highest], Scale::Linear)?;
    panel.level(100.0, None);
    panel.level(-100.0, None);
    for (&(joint, _), (_, colour)) in joints.iter().zip(&legend) {
        panel.rows(&recording.frames, *colour, None, |row| share(row, joint));
    }
    Ok(panel.canvas)
}

fn cycle_time(setup: &Setup, recording: &Recording) -> Result<Canvas, CanvasError> {
    let parts = ["state_in", "shift", "linearize", "riccati", "qp", "publish"];
    let names = ["state in", "shift", "linearise", "riccati", "QP", "publish"];
    let colours = [[159, 179, 200, 255], PALETTE[5], PALETTE[0], PALETTE[2], PALETTE[4], PALETTE[3]];
    let cycles = &recording.cycles;
    let deadline = 1e3 / setup.scenario.controller.mpc_rate_hz;
    let mut totals: Vec<f64> = (0..cycles["total"].rows()).map(|row| cycles["total"].at(row, 0)).collect();
    totals.sort_by(f64::total_cmp);
    let usual = totals.get(totals.len().saturating_sub(1) * 95 / 100).copied().unwrap_or_default();
    let y = [0.0, (1.3 * deadline).max(1.15 * usual.min(12.0 * deadline))];
    let mut legend: Vec<(&str, Colour)> = names.into_iter().zip(colours).collect();
    legend.push(("deadline", INK));
    let mut panel = Panel::new(setup, recording, "Cycle time, ms", &legend, y, Scale::Linear)?;
    let [.., bottom] = panel.frame();
    let time = &cycles["time"];
    let end = panel.x[1];
    let sum_to =
        |row: usize, part: usize| parts[..=part].iter().map(|name| cycles[name].at(row, 0)).sum::<f64>();
    for part in (0..parts.len()).rev() {
        let mut points = vec![];
        for row in 0..time.rows() {
            let until = if row + 1 < time.rows() { time.at(row + 1, 0) } else { end };
            let y = panel.place_y(sum_to(row, part));
            points.extend([[panel.place_x(time.at(row, 0)), y], [panel.place_x(until), y]]);
        }
        if let (Some(first), Some(last)) = (points.first().copied(), points.last().copied()) {
            points.extend([[last[0], bottom], [first[0], bottom]]);
        }
        panel.canvas.polygon(points, colours[part]);
    }
    panel.level(deadline, None);
    Ok(panel.canvas)
}

fn constraints(setup: &Setup, recording: &Recording) -> Result<Canvas, CanvasError> {
    let list = [("active rows", "active"), ("QP solves", "solves"), ("dropped rows", "dropped")];
    let colours = [PALETTE[0], PALETTE[2], PALETTE[1]];
    let cycles = &recording.cycles;
    let of = |column: &Column| (0..column.rows()).map(|row| column.at(row, 0)).fold(4.0, f64::max);
    let highest = list.iter().map(|(_, name)| of(&cycles[name])).fold(0.0, f64::max);
    let legend: Vec<(&str, Colour)> =
        list.iter().zip(colours).map(|((label, _), colour)| (*label, colour)).collect();
    let y = [0.0, 1.08 * highest];
    let mut panel =
        Panel::new(setup, recording, "Active constraints, rows per cycle", &legend, y, Scale::Linear)?;
    for ((_, name), colour) in list.into_iter().zip(colours) {
        panel.rows(cycles, colour, None, |row| cycles[name].at(row, 0));
    }
    Ok(panel.canvas)
}

/// The path of the pressure point in the sole, seen from above, toes up.
fn sole_from_above(
    setup: &Setup,
    recording: &Recording,
    polygon: &[[f64; 2]],
) -> Result<Canvas, CanvasError> {
    const HEIGHT: f32 = 900.0;
    const ROOM: f32 = 60.0;
    const HEAD: f32 = 60.0;
    let range = |axis: usize| {
        let values = polygon.iter().map(move |corner| corner[axis]);
        [values.clone().fold(f64::INFINITY, f64::min), values.fold(f64::NEG_INFINITY, f64::max)]
    };
    let (x, y) = (range(0), range(1));
    let scale = (HEIGHT - HEAD - 2.0 * ROOM) / (x[1] - x[0]) as f32;
    let width = (scale * (y[1] - y[0]) as f32 + 2.0 * ROOM).max(420.0);
    let mut canvas = Canvas::new(width as u32, HEIGHT as u32, WHITE)?;
    let middle = (y[0] + y[1]) / 2.0;
    let at = |point: [f64; 2]| {
        [width / 2.0 - scale * (point[1] - middle) as f32, HEAD + ROOM + scale * (x[1] - point[0]) as f32]
    };
    canvas.text([width / 2.0, 32.0], Align::Centre, Text::Title, "Pressure point, toes up", INK);
    canvas.polygon(polygon.iter().map(|corner| at(*corner)), [0, 114, 178, 16]);
    let closed = polygon.iter().chain(polygon.first()).map(|corner| at(*corner));
    canvas.line(closed, INK, 3.0, None);
    let pressure = &recording.frames["pressure"];
    let path = (0..pressure.rows()).map(|row| at([pressure.at(row, 0), pressure.at(row, 1)]));
    canvas.line(path, PALETTE[0], 1.6, None);
    // A scale of 50 mm, and the name of the foot.
    let [right, bottom] = [width - ROOM, HEIGHT - 26.0];
    canvas.line([[right - 0.05 * scale, bottom], [right, bottom]], SOFT, 3.0, None);
    canvas.text([right - 0.05 * scale - 12.0, bottom], Align::Right, Text::Small, "50 mm", SOFT);
    canvas.text([ROOM, bottom], Align::Left, Text::Small, setup.scenario.robot.stance.first(), SOFT);
    canvas.disc(at([0.0, 0.0]), 4.0, SOFT);
    Ok(canvas)
}

/// Range of values with some room, with the given ones inside.
fn span(values: impl Iterator<Item = f64>, always: [f64; 2]) -> [f64; 2] {
    let start = (always[0], always[1]);
    let (low, high) =
        values.filter(|v| v.is_finite()).fold(start, |(low, high), v| (low.min(v), high.max(v)));
    let room = 0.06 * (high - low);
    [low - room, high + room]
}

/// Round numbers in a range, about `count` of them.
fn ticks([low, high]: [f64; 2], count: f64) -> Vec<f64> {
    let raw = (high - low) / count;
    let power = 10_f64.powf(raw.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].map(|k| k * power).into_iter().find(|&step| step >= raw * 0.999);
    let step = step.unwrap_or(10.0 * power);
    let first = (low / step - 1e-9).ceil() as i64;
    (first..).map(|k| k as f64 * step).take_while(|&value| value <= high + 1e-9 * step).take(64).collect()
}

/// A tick as text: without the tail of rounding.
fn label(value: f64) -> String {
    let text = format!("{value:.6}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" { "0".to_owned() } else { text.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        assert_eq!(ticks([0.0, 10.0], 10.0), [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0]);
        assert_eq!(ticks([-0.03, 0.05], 4.0), [-0.02, 0.0, 0.02, 0.04]);
        assert_eq!(ticks([-87.0, 172.0], 6.0), [-50.0, 0.0, 50.0, 100.0, 150.0]);
        assert_eq!([0.1 + 0.2, -0.0, 1000.0].map(label), ["0.3", "0", "1000"]);
    }
}
