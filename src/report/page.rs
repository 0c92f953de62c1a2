//! The page: template, style, script and data put together.

use std::collections::BTreeMap;

use delmpc_scenario::Clock;
use serde_json::{Value, json};

use crate::report::criteria::criteria;
use crate::report::recording::{Column, Recording, Table};
use crate::report::scene::{Scene, pose};
use crate::setup::Setup;
use crate::verdict::Failure;

const PAGE: &str = include_str!("template/page.html");
const STYLE: &str = include_str!("template/style.css");
/// In the order in which they need each other.
const SCRIPTS: [&str; 7] = [
    include_str!("template/data.js"),
    include_str!("template/kinematics.js"),
    include_str!("template/mesh.js"),
    include_str!("template/view.js"),
    include_str!("template/plots.js"),
    include_str!("template/page.js"),
    include_str!("template/live.js"),
];

/// The page of a run that is over.
///
/// # Errors
/// When the data cannot be written as JSON.
pub fn page(setup: &Setup, recording: &Recording, summary: &Value) -> Result<String, Failure> {
    let mut data = description(setup);
    if let Value::Object(data) = &mut data {
        let failure = summary.get("failure").and_then(Value::as_str);
        let success = summary.get("success").and_then(Value::as_bool);
        data.insert("outcome".to_owned(), json!({"success": success, "failure": failure}));
        data.insert("about".to_owned(), json!(recording.about));
        let list = criteria(&setup.scenario, setup.robot.soles.len(), summary);
        data.insert("criteria".to_owned(), json!(list));
        data.insert("figures".to_owned(), summary.clone());
        data.insert("frame_s".to_owned(), json!(recording.frame_s));
        data.insert("frames".to_owned(), table(&recording.frames));
        data.insert("cycles".to_owned(), table(&recording.cycles));
        data.insert("damage".to_owned(), json!(recording.damage));
    }
    assemble(&setup.scenario.name, &data)
}

/// What a page knows of a run before it begins: robot, scenario, events.
pub fn description(setup: &Setup) -> Value {
    let Setup { scenario, robot, .. } = setup;
    let stance = robot.soles.iter().position(|sole| sole.name == scenario.robot.stance.first());
    let hand = scenario.reach.as_ref().and_then(|reach| robot.frame(&reach.hand));
    json!({
        "scenario": scenario.name,
        "seed": scenario.seed,
        "timed": scenario.clock == Clock::Realtime,
        "duration_s": scenario.duration_s,
        "robot": Scene::new(robot),
        "stance": stance,
        "gravity": robot.tree.gravity_w().norm(),
        "cycle_s": 1.0 / scenario.controller.mpc_rate_hz,
        "cop_margin_m": scenario.controller.constraints.cop_margin_m,
        "torque_fraction": scenario.controller.constraints.torque_fraction,
        "ball": setup.ball_w().ok().flatten(),
        "hand": hand.map(|hand| json!({"body": hand.body, "pose": pose(&hand.pose)})),
        "hand_limits_m": [scenario.success.hand_error_at_deadline_m, scenario.success.hand_error_hold_max_m],
        "events": events(setup),
    })
}

/// What happens when, by the scenario.
fn events(setup: &Setup) -> Vec<Value> {
    let Setup { scenario, robot, .. } = setup;
    let mut events = Vec::new();
    let mut event = |kind: &str, label: String, from_s: f64, to_s: f64, body: Option<usize>| {
        if from_s < scenario.duration_s {
            let to_s = to_s.min(scenario.duration_s);
            events.push(json!({"kind": kind, "label": label, "from": from_s, "to": to_s, "body": body}));
        }
    };
    if let Some(reach) = &scenario.reach {
        let deadline_s = reach.start_s + reach.deadline_s;
        event("reach", "reach".to_owned(), reach.start_s, deadline_s, None);
        event("hold", "hold".to_owned(), deadline_s, deadline_s + reach.hold_s, None);
    }
    for push in scenario.push.iter().filter(|push| push.impulse_ns > 0.0) {
        let body = robot.link(&push.link).and_then(|link| link.body);
        event(
            "push",
            format!("push {} N s", push.impulse_ns),
            push.start_s,
            push.start_s + push.duration_s,
            body,
        );
    }
    events
}

/// Columns as base64 of little-endian 32-bit numbers.
fn table(table: &Table) -> Value {
    let encode = |column: &Column| {
        let bytes: Vec<u8> = column.values.iter().flat_map(|value| value.to_le_bytes()).collect();
        json!({"width": column.width, "base64": base64(&bytes)})
    };
    let columns: BTreeMap<&str, Value> = table.iter().map(|(name, column)| (*name, encode(column))).collect();
    json!(columns)
}

/// Base64 with padding. Source: RFC 4648, section 4.
fn base64(bytes: &[u8]) -> String {
    const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let group =
            chunk.iter().enumerate().fold(0_u32, |group, (i, &byte)| group | u32::from(byte) << (16 - 8 * i));
        for digit in 0..4 {
            let index = (group >> (18 - 6 * digit)) as usize & 63;
            text.push(if digit <= chunk.len() { ALPHABET[index] as char } else { '=' });
        }
    }
    text
}

/// Puts data into the template. `<` is escaped: no text of a file can end the script element it stands in.
pub fn assemble(title: &str, data: &Value) -> Result<String, Failure> {
    let data = serde_json::to_string(data).map_err(Failure::fault)?.replace('<', "\\u003c");
    let title = title.replace('&', "&amp;").replace('<', "&lt;");
    let mut page = String::with_capacity(data.len() + 200_000);
    // Not by chained replacement: what is inserted must not be searched for further placeholders.
    let mut rest = PAGE;
    while let Some((before, after)) = rest.split_once("{{") {
        page.push_str(before);
        let Some((name, after)) = after.split_once("}}") else { break };
        match name {
            "title" => page.push_str(&title),
            "style" => page.push_str(STYLE),
            "data" => page.push_str(&data),
            "script" => SCRIPTS.iter().for_each(|script| page.push_str(script)),
            _ => {}
        }
        rest = after;
    }
    page.push_str(rest);
    Ok(page)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_is_that_of_the_rfc() {
        let cases = [
            ("", ""),
            ("f", "Zg=="),
            ("fo", "Zm8="),
            ("foo", "Zm9v"),
            ("foob", "Zm9vYg=="),
            ("foobar", "Zm9vYmFy"),
        ];
        for (plain, encoded) in cases {
            assert_eq!(base64(plain.as_bytes()), encoded);
        }
    }

    #[test]
    fn no_text_can_leave_its_place_in_the_page() {
        let page =
            assemble("<b>&{{data}}", &json!({"scenario": "</script><script>alert(1)</script>{{style}}"}))
                .unwrap();
        assert!(page.contains("<title>&lt;b>&amp;{{data}}"));
        assert!(!page.contains("alert(1)</script>"));
        assert_eq!(page.matches("{{style}}").count(), 1, "kept as text");
    }

    #[test]
    fn the_page_asks_for_nothing_from_elsewhere() {
        let page = assemble("x", &json!({})).unwrap();
        for text in ["http://", "https://", "//cdn", "@import", "src="] {
            // The namespace of SVG is a name, not an address that is fetched.
            assert!(!page.replace("http://www.w3.org/2000/svg", "").contains(text), "{text}");
        }
    }
}
