//! Plans that other software made: every residual recomputed from the file with the mechanics alone.
//!
//! `vectors/*.json` were solved by a prototype in Python with its own mechanics.
#![allow(clippy::unwrap_used, reason = "helpers of tests: what fails here is a failed test")]

use crate::common;

use std::path::PathBuf;

use delmpc_planner::check::{Bounds, check};
use delmpc_planner::plan_file::Plan;

fn vector(name: &str) -> Plan {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/vectors");
    Plan::read(&folder.join(name).with_extension("json")).unwrap()
}

#[test]
fn residuals_of_delivered_plans_are_as_listed() {
    for (name, robot) in [
        ("flamingo_jump_24", "spring_flamingo"),
        ("flamingo_jump_36", "spring_flamingo"),
        ("littledog_gaps_28", "littledog"),
    ] {
        let plan = vector(name);
        let findings = check(&plan, &common::robot(robot)).unwrap();
        println!("{name}: {findings:#?}");
        assert!(findings.del_s <= 1e-12, "{name}: DEL {:e} S", findings.del_s);
        assert!(findings.passes(&Bounds::default()), "{name}: {:?}", findings.judged(&Bounds::default()));
        let listed = |key: &str| plan.residual[key].as_f64().unwrap();
        let near = |got: f64, want: f64, digits: f64| (got - want).abs() <= digits;
        if name.starts_with("flamingo") {
            assert!(near(findings.gap_m, listed("gap"), 1e-12), "{name}: {:e}", findings.gap_m);
        } else {
            // The list counts its gap beside the 0.5 mm that its rows allow: what the products leave of a loaded contact.
            assert!(findings.gap_m < 2.0 * listed("gap"), "{name}: {:e}", findings.gap_m);
        }
        assert!(
            near(findings.product_s_m, listed("comp") + plan.kappa, 1e-11),
            "{name}: {:e}",
            findings.product_s_m
        );
        if let Some(facts) = plan.facts.as_object() {
            let fact = |key: &str| facts[key].as_f64().unwrap();
            assert!(near(findings.clearance_m.unwrap(), fact("clearance_m"), 1e-3));
            assert!(near(findings.lowest_m, fact("lowest_point_m"), 2e-4));
            assert!(near(findings.mean_speed_m_s, fact("mean_speed"), 1e-9));
        }
    }
}

#[test]
fn a_changed_number_is_found() {
    let robot = common::robot("spring_flamingo");
    let mut plan = vector("flamingo_jump_24");
    plan.u[7][1] += 1e-3;
    assert!(check(&plan, &robot).unwrap().del_s > 1e-6);
    let mut plan = vector("flamingo_jump_24");
    plan.impulse[10][2][1][1] += 1e-3;
    assert!(!check(&plan, &robot).unwrap().passes(&Bounds::default()));
    let mut plan = vector("flamingo_jump_24");
    plan.q_mid[10][1] -= 0.2;
    let findings = check(&plan, &robot).unwrap();
    assert!(findings.gap_m > 0.05 && !findings.passes(&Bounds::default()));
}
