//! The polar plot of a push map.

use std::fmt::Write as _;

use super::Limit;

/// Survived impulse over direction, straight ahead is up, with the capture limit.
pub(super) fn polar_plot(limits: &[Limit]) -> String {
    const SIZE: f64 = 560.0;
    const COLOURS: [&str; 4] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7"];
    let most = limits.iter().map(|limit| limit.least_ns.max(limit.capture_limit_ns)).fold(1.0, f64::max);
    let ring = [5.0, 10.0, 20.0, 50.0, 100.0].into_iter().find(|ring| most / ring <= 5.0).unwrap_or(200.0);
    let rings = (most / ring).ceil();
    let scale = 0.40 * SIZE / (rings * ring);
    let centre = 0.5 * SIZE;
    let at = |angle: f64, radius: f64| {
        (centre - scale * radius * angle.sin(), centre - scale * radius * angle.cos())
    };
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {SIZE} {SIZE}\" font-family=\"sans-serif\" \
         font-size=\"12\" fill=\"#333\">\n<rect width=\"{SIZE}\" height=\"{SIZE}\" fill=\"#fff\"/>\n\
         <text x=\"16\" y=\"24\" font-size=\"15\">Largest push survived, N·s</text>\n"
    );
    for k in 1..=rings as usize {
        let radius = k as f64 * ring;
        let _ = writeln!(
            svg,
            "<circle cx=\"{centre}\" cy=\"{centre}\" r=\"{:.1}\" fill=\"none\" stroke=\"#ddd\"/>\
             <text x=\"{:.1}\" y=\"{:.1}\" fill=\"#777\">{radius}</text>",
            scale * radius,
            centre + 3.0,
            centre - scale * radius - 3.0
        );
    }
    for (angle, name) in [(0.0, "forward"), (90.0, "left"), (180.0, "back"), (270.0, "right")] {
        let (x, y) = at(f64::to_radians(angle), rings * ring * 1.12);
        let _ = writeln!(svg, "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"middle\">{name}</text>");
    }
    let curve = |points: &mut dyn Iterator<Item = (f64, f64)>| {
        let text: Vec<String> = points
            .map(|(angle, radius)| {
                let (x, y) = at(angle, radius);
                format!("{x:.1},{y:.1}")
            })
            .collect();
        text.join(" ")
    };
    let mut drawn: Vec<(&str, &str)> = Vec::new();
    for limit in limits {
        if drawn.contains(&(&limit.controller, &limit.link)) {
            continue;
        }
        let colour = COLOURS[drawn.len() % COLOURS.len()];
        let same = || limits.iter().filter(|l| l.controller == limit.controller && l.link == limit.link);
        if drawn.is_empty() {
            let points = curve(&mut same().map(|l| (l.angle_rad, l.capture_limit_ns)));
            let _ = writeln!(
                svg,
                "<polygon points=\"{points}\" fill=\"none\" stroke=\"#777\" stroke-dasharray=\"5 4\"/>\
                 <text x=\"16\" y=\"44\" fill=\"#777\">- - capture limit</text>"
            );
        }
        let points = curve(&mut same().map(|l| (l.angle_rad, l.least_ns)));
        let _ = writeln!(
            svg,
            "<polygon points=\"{points}\" fill=\"{colour}\" fill-opacity=\"0.12\" stroke=\"{colour}\" \
             stroke-width=\"2\"/><text x=\"16\" y=\"{}\" fill=\"{colour}\">{} at {}</text>",
            64 + 20 * drawn.len(),
            limit.controller,
            limit.link
        );
        drawn.push((&limit.controller, &limit.link));
    }
    svg.push_str("</svg>\n");
    svg
}
