//! Spring Flamingo jumps over a box 0.16 m high; nobody names a contact mode.
#![allow(clippy::unwrap_used, reason = "helpers of tests: what fails here is a failed test")]

use crate::common;

use delmpc_planner::planner::{Search, plan};

#[test]
fn jump_from_the_plain_guess() {
    let task = common::flamingo_jump(24);
    let search = Search { refine_to: Some(48), ..Search::default() };
    let planned = plan(&task, "flamingo_jump", &search, |_| true).unwrap();
    let findings = &planned.findings;
    println!("{:#?}\n{:#?}", planned.attempts, findings);
    assert!(planned.converged, "{:?}", planned.attempts);
    assert!(planned.attempts[0].violation <= 1e-5);
    assert!(findings.longest_flight_s >= 0.15);
    assert!(findings.clearance_m.unwrap() >= 5e-3);
    assert!((0.85..=0.95).contains(&findings.mean_speed_m_s));
    assert!(findings.product_s_m <= 5e-6);
    assert!(findings.del_s <= 1e-10);
    assert!(findings.lowest_m >= -3e-3);
    assert!(planned.plan.stages == 48 && findings.longest_stage_s <= 0.0545);
}

/// Seeded guesses, other frictions, no obstacle: what comes out, and that it is another motion.
#[test]
#[ignore = "a campaign of minutes"]
fn guesses_frictions_and_no_obstacle() {
    let task = common::flamingo_jump(24);
    let mut good = 0;
    for seed in 1..=10 {
        // The second guess of a search is the first shifted one.
        let search = Search { guesses: 2, seed, ..Search::default() };
        let mut first = true;
        let planned = plan(&task, "jump", &search, |report| {
            first &= report.guess == 0;
            // The plain guess is known: only the shifted one is of interest.
            report.guess > 0
        })
        .unwrap();
        let attempt = &planned.attempts[1];
        println!("seed {seed}: {attempt:?}");
        good += usize::from(attempt.violation <= 1e-5);
    }
    println!("{good} of 10 seeded guesses reach a violation of 1e-5");
    let with = plan(&task, "jump", &Search::default(), |_| true).unwrap();
    let mut without = task.clone();
    without.terrain.obstacles.clear();
    let without = plan(&without, "no obstacle", &Search::default(), |_| true).unwrap();
    println!("without the obstacle: {:?}", without.attempts);
    let apart = with.plan.q.iter().flatten().zip(without.plan.q.iter().flatten());
    assert!(apart.fold(0.0f64, |worst, (a, b)| worst.max((a - b).abs())) > 0.1);
    for friction in [0.2, 0.4] {
        let mut slippery = task.clone();
        slippery.friction = friction;
        let planned = plan(&slippery, "slippery", &Search::default(), |_| true).unwrap();
        println!("friction {friction}: {:?}", planned.attempts);
        assert!(planned.findings.cone_s <= 1e-5);
    }
    assert!(good >= 9);
}
