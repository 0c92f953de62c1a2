//! LittleDog walks over two gaps in space; nobody names a gait.
#![allow(clippy::unwrap_used, reason = "helpers of tests: what fails here is a failed test")]

use crate::common;

use delmpc_planner::planner::{Planned, Search, plan};

fn search() -> Search {
    Search::of(&common::littledog_gaps(28))
}

fn assert_walks(planned: &Planned) {
    let findings = &planned.findings;
    assert!(planned.converged, "{:?}", planned.attempts);
    assert!(findings.mean_speed_m_s >= 0.24, "{findings:#?}");
    assert!(findings.edge_m.unwrap() >= 20e-3, "{findings:#?}");
    assert!(findings.product_s_m <= 5e-6, "{findings:#?}");
    assert!(findings.del_s <= 1e-10, "{findings:#?}");
}

/// Half a minute of one core in an optimised build.
#[test]
#[ignore = "a plan of half a minute in release, several minutes in the test profile"]
fn walks_over_both_gaps_from_the_plain_guess() {
    let planned = plan(&common::littledog_gaps(28), "littledog_gaps", &search(), |_| true).unwrap();
    println!("{:#?}\n{:#?}\n{:#?}", planned.attempts, planned.findings, planned.plan.sets());
    assert_walks(&planned);
}

/// The plan of the handbook's prototype, solved again from a relaxation: the end of the homotopy by itself.
#[test]
fn a_delivered_plan_is_solved_again() {
    use delmpc_planner::homotopy::{Schedule, second_pass};
    use delmpc_planner::newton::Minimiser;
    use delmpc_planner::plan_file::Plan;

    let task = common::littledog_gaps(28);
    let problem = task.problem().unwrap();
    let file = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/vectors/littledog_gaps_28.json");
    let x = Plan::read(&file).unwrap().to_vector(&problem).unwrap();
    let mut minimiser = Minimiser::new(&problem, &x);
    let before = {
        minimiser.evaluate(delmpc_planner::contact_law::Homotopy { kappa: 1e-4, sigma: 1.0 });
        minimiser.violation()
    };
    // Two values of κ are enough to see that it comes down.
    let schedule = Schedule { kappa_end: 3e-5, ..Schedule::spatial() };
    let outcome = second_pass(&mut minimiser, &schedule, 1e-4, &mut |_| true).unwrap();
    println!("violation {before:.1e}, then {:.1e}", outcome.progress.violation);
    assert!(outcome.progress.violation < 1e-4, "{:?}", outcome.progress);
}

/// Seeded guesses: how many of ten end in a plan.
#[test]
#[ignore = "a campaign of ten minutes in release"]
fn seeded_guesses() {
    let task = common::littledog_gaps(28);
    let mut good = 0;
    for seed in 1..=10 {
        // The second guess of a search is the first shifted one; the plain guess is known.
        let search = Search { guesses: 2, seed, ..search() };
        let planned = plan(&task, "littledog_gaps", &search, |report| report.guess > 0).unwrap();
        let attempt = &planned.attempts[1];
        println!("seed {seed}: {attempt:?}");
        good += usize::from(attempt.violation <= 1e-5);
    }
    println!("{good} of 10 seeded guesses reach a violation of 1e-5");
    assert!(good >= 6);
}
