//! Complexity by instruction count: Algorithm 1 and Algorithm B.1 are O(n), the linearisation by recursion is O(n²).
//!
//! | command | what it does |
//! |---|---|
//! | `cargo bench -p delmpc-mechanics --bench complexity` | counts with callgrind, prints the table, writes `runs/complexity.csv` and `.svg`; about a minute |
//! | `.. -- --count ALGORITHM N REPEATS` | runs one algorithm on a chain of `N` links; what callgrind watches |
//! | `.. -- --profile step\|linearize REPEATS` | Atlas on its foot, Simpson: for `valgrind --tool=callgrind`, to see where instructions go |
//!
//! Instructions per call are the difference of two runs that differ in the number of repeats: process start, construction and
//! warm-up cancel exactly, and nothing depends on the machine's load. The count does depend on compiler and instruction set.
#![allow(
    clippy::panic,
    clippy::unwrap_used,
    reason = "a program for developers: a model that does not build ends it"
)]

#[path = "../tests/oracle/mod.rs"]
mod oracle;

use std::fmt::Write as _;
use std::hint::black_box;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

use delmpc_mechanics::del_residual::{DelWorkspace, ForceCapacity};
use delmpc_mechanics::newton_direction::NewtonSolver;
use delmpc_mechanics::prelude::*;

const SIZES: [usize; 5] = [32, 64, 128, 256, 512];
/// Simpson.
const UNKNOWN_NODES: usize = 2;
const TIME_STEP: f64 = 0.005;

/// One line of the table.
struct Algorithm {
    key: &'static str,
    title: &'static str,
    /// Largest exponent the issue allows; the others are there to compare with.
    bar: Option<f64>,
    /// Repeats of the longer run; the shorter one makes half of them, rounded down.
    repeats: usize,
    /// Longest chain: the steep ones stop where callgrind would take minutes.
    longest: usize,
    color: &'static str,
}

const ALGORITHMS: [Algorithm; 6] = [
    Algorithm {
        key: "residual",
        title: "Algorithm 1",
        bar: Some(1.1),
        repeats: 20,
        longest: 512,
        color: "#1b6ca8",
    },
    Algorithm {
        key: "recursive",
        title: "B.1 factor + solve",
        bar: Some(1.1),
        repeats: 20,
        longest: 512,
        color: "#c0392b",
    },
    Algorithm {
        key: "branch_lu",
        title: "branch LU factor + solve",
        bar: None,
        repeats: 1,
        longest: 256,
        color: "#e59866",
    },
    Algorithm {
        key: "recursion",
        title: "A, B by recursion",
        bar: Some(2.1),
        repeats: 2,
        longest: 512,
        color: "#1e8449",
    },
    Algorithm {
        key: "tangent",
        title: "A, B by tangents",
        bar: Some(2.1),
        repeats: 1,
        longest: 128,
        color: "#58d68d",
    },
    Algorithm {
        key: "matrix",
        title: "A, B matrix path",
        bar: None,
        repeats: 1,
        longest: 128,
        color: "#aab7b8",
    },
];

fn chain(n: usize) -> KinematicTree {
    let length = 0.1;
    let rod = LinkInertia::new(
        1.0,
        Vector3::new(0.0, 0.0, -0.5 * length),
        Matrix3::from_diagonal(&Vector3::new(0.01, 0.01, 0.001)),
    );
    let mut builder = TreeBuilder::fixed_base(Vector3::new(0.0, 0.0, -9.81));
    let mut parent = None;
    for i in 0..n {
        let z = if i == 0 { 0.0 } else { -length };
        let placement = RigidTransform::from_translation(Vector3::new(0.0, 0.0, z));
        parent = Some(builder.add(Body::new(parent, Joint::revolute(Vector3::y(), placement), rod)));
    }
    builder.build().unwrap()
}

fn spread(n: usize, size: f64) -> Vec<f64> {
    (0..n).map(|k| size * ((k as f64 + 1.0) * 12.9898).sin()).collect()
}

/// Runs one algorithm `repeats` times on a chain of `n` links, around nodes of a motion (not solved: counting needs no solution).
fn run(algorithm: &str, n: usize, repeats: usize) {
    let tree = chain(n);
    let rule = LobattoRule::new(UNKNOWN_NODES).unwrap();
    let mut state = State::zeros(&tree);
    state.q = spread(n, 0.3);
    let torque = vec![0.0; n];
    let forces = StepForces::held(&torque);
    let place_nodes = |del: &mut DelWorkspace| {
        del.begin(&tree, &state, &forces).unwrap();
        for (dof, rate) in spread(n, 0.2).into_iter().enumerate() {
            for alpha in 1..=UNKNOWN_NODES {
                let time = rule.nodes()[alpha] * TIME_STEP;
                del.set_node(alpha, dof, state.q[dof] + rate * time);
            }
        }
        del.evaluate(&tree, &[]);
    };
    let mut vector = vec![0.0; UNKNOWN_NODES * n];
    match algorithm {
        "residual" => {
            let mut del = DelWorkspace::new(&tree, &rule, TIME_STEP, ForceCapacity::default()).unwrap();
            place_nodes(&mut del);
            for _ in 0..repeats {
                del.evaluate(&tree, &[]);
                del.residual_into(&tree, &mut vector);
                black_box(&mut vector);
            }
        }
        "recursive" | "branch_lu" => {
            let mut del = DelWorkspace::new(&tree, &rule, TIME_STEP, ForceCapacity::default()).unwrap();
            place_nodes(&mut del);
            let method =
                if algorithm == "recursive" { NewtonMethod::Recursive } else { NewtonMethod::BranchLu };
            let mut solver = NewtonSolver::new(method, &tree, &del);
            for _ in 0..repeats {
                solver.factor(&tree, black_box(&del)).unwrap();
                vector.fill(1.0);
                solver.solve(&tree, &mut vector);
                black_box(&mut vector);
            }
        }
        "recursion" | "tangent" | "matrix" => {
            let method = if algorithm == "matrix" { NewtonMethod::BranchLu } else { NewtonMethod::Recursive };
            let options = StepOptions { method: Some(method), dense_fallback: 0, ..StepOptions::default() };
            let mut integrator = Integrator::new(&tree, &rule, TIME_STEP, options).unwrap();
            place_nodes(integrator.del_and_solver().0);
            let coordinates = StateCoordinates::Momentum;
            let mut work = Linearizer::new(&tree, &integrator, coordinates, InputHold::Held).unwrap();
            for _ in 0..repeats {
                black_box(match algorithm {
                    "recursion" => work.linearize_by_recursion(&tree, &mut integrator).unwrap(),
                    "tangent" => work.linearize_by_tangent(&tree, &mut integrator).unwrap(),
                    _ => work.linearize_by_matrix(&tree, &mut integrator).unwrap(),
                });
            }
        }
        other => panic!("no algorithm '{other}'"),
    }
}

/// Warm steps, or linearisations of a solved step, of Atlas on its foot.
fn profile(what: &str, repeats: usize) {
    let case = oracle::Case::new("atlas".into(), oracle::read("atlas_v4_rfoot_s2.json"));
    let tree = &case.tree;
    let torque = spread(tree.dof(), 1.0);
    let forces = StepForces::held(&torque);
    let options = StepOptions { method: Some(NewtonMethod::BranchLu), ..StepOptions::default() };
    let rule = LobattoRule::new(UNKNOWN_NODES).unwrap();
    let mut integrator = Integrator::new(tree, &rule, 0.01, options).unwrap();
    let mut state = State::zeros(tree);
    state.q.copy_from_slice(&case.state.q);
    integrator.velocities().set_velocity(tree, &mut state, &spread(tree.dof(), 0.2)).unwrap();
    let mut work = Linearizer::new(tree, &integrator, StateCoordinates::Momentum, InputHold::Held).unwrap();
    for _ in 0..4 {
        integrator.step(tree, &mut state, &forces).unwrap();
    }
    let (mut iterations, mut factorizations) = (0, 0);
    for _ in 0..repeats {
        if what == "step" {
            let report = integrator.step(tree, &mut state, &forces).unwrap();
            iterations += report.iterations;
            factorizations += report.factorizations;
        } else {
            black_box(work.linearize(tree, &mut integrator).unwrap());
        }
    }
    eprintln!("{repeats} x {what}: {iterations} iterations, {factorizations} factorisations");
}

/// Instructions of one run under callgrind.
fn instructions(algorithm: &str, n: usize, repeats: usize) -> Result<u64, String> {
    let own = std::env::current_exe().map_err(|e| format!("this program's own path: {e}"))?;
    let output = Command::new("valgrind")
        .args(["--tool=callgrind", "--callgrind-out-file=/dev/null"])
        .arg(own)
        .args(["--count", algorithm, &n.to_string(), &repeats.to_string()])
        .output()
        .map_err(|e| format!("cannot run valgrind ({e}): install it (Debian: apt install valgrind)"))?;
    let text = String::from_utf8_lossy(&output.stderr);
    if !output.status.success() {
        return Err(format!("valgrind failed on {algorithm}, n = {n}:\n{text}"));
    }
    let collected = text.lines().find_map(|line| line.split("Collected :").nth(1));
    let count = collected.and_then(|count| count.trim().parse().ok());
    count.ok_or_else(|| format!("valgrind reported no instruction count:\n{text}"))
}

/// Least-squares slope of `log(y)` over `log(x)`.
fn exponent(x: &[usize], y: &[f64]) -> f64 {
    let logs = |v: Vec<f64>| v.into_iter().map(f64::ln).collect::<Vec<f64>>();
    let (x, y) = (logs(x.iter().map(|&x| x as f64).collect()), logs(y.to_vec()));
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    let (mx, my) = (mean(&x), mean(&y));
    let cross: f64 = x.iter().zip(&y).map(|(x, y)| (x - mx) * (y - my)).sum();
    cross / x.iter().map(|x| (x - mx) * (x - mx)).sum::<f64>()
}

fn thousands(count: f64) -> String {
    let digits = format!("{count:.0}");
    let mut out = String::new();
    for (k, digit) in digits.chars().enumerate() {
        if k > 0 && (digits.len() - k) % 3 == 0 {
            out.push(' ');
        }
        out.push(digit);
    }
    out
}

/// Log-log plot: one line per algorithm, decades as grid.
fn plot(series: &[(&Algorithm, Vec<f64>, f64)]) -> String {
    let (width, height, left, right, top, bottom) = (760.0, 520.0, 80.0, 250.0, 30.0, 60.0);
    let all = series.iter().flat_map(|(_, counts, _)| counts.iter().copied());
    let low = all.clone().fold(f64::INFINITY, f64::min).log10().floor();
    let high = all.fold(0.0, f64::max).log10().ceil();
    let (first, last) = ((SIZES[0] as f64).log2(), (SIZES[SIZES.len() - 1] as f64).log2());
    let x = |n: usize| left + ((n as f64).log2() - first) / (last - first) * (width - left - right);
    let y = |count: f64| height - bottom - (count.log10() - low) / (high - low) * (height - top - bottom);
    let mut svg = String::new();
    let mut line = |text: String| {
        svg.push_str(&text);
        svg.push('\n');
    };
    line(format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" font-family=\"sans-serif\" font-size=\"13\">"
    ));
    line(format!("<rect width=\"{width}\" height=\"{height}\" fill=\"white\"/>"));
    for n in SIZES {
        let at = x(n);
        line(format!(
            "<line x1=\"{at:.1}\" y1=\"{top}\" x2=\"{at:.1}\" y2=\"{:.1}\" stroke=\"#ddd\"/><text x=\"{at:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{n}</text>",
            height - bottom,
            height - bottom + 20.0
        ));
    }
    let mut decade = low;
    while decade <= high {
        let at = y(10f64.powf(decade));
        line(format!(
            "<line x1=\"{left}\" y1=\"{at:.1}\" x2=\"{:.1}\" y2=\"{at:.1}\" stroke=\"#ddd\"/><text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">10<tspan dy=\"-5\" font-size=\"10\">{decade}</tspan></text>",
            width - right,
            left - 8.0,
            at + 4.0
        ));
        decade += 1.0;
    }
    line(format!(
        "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">links n of a chain (s = {UNKNOWN_NODES})</text>",
        (left + width - right) / 2.0,
        height - 18.0
    ));
    line(format!(
        "<text transform=\"translate(22 {:.1}) rotate(-90)\" text-anchor=\"middle\">instructions per call</text>",
        (top + height - bottom) / 2.0
    ));
    for (k, (algorithm, counts, slope)) in series.iter().enumerate() {
        let points: Vec<String> =
            SIZES.iter().zip(counts).map(|(&n, &count)| format!("{:.1},{:.1}", x(n), y(count))).collect();
        let color = algorithm.color;
        line(format!(
            "<polyline points=\"{}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"2\"/>",
            points.join(" ")
        ));
        for (&n, &count) in SIZES.iter().zip(counts) {
            line(format!("<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"3.5\" fill=\"{color}\"/>", x(n), y(count)));
        }
        let (at, row) = (width - right + 20.0, top + 20.0 + 24.0 * k as f64);
        line(format!(
            "<line x1=\"{at}\" y1=\"{:.1}\" x2=\"{:.1}\" y2=\"{:.1}\" stroke=\"{color}\" stroke-width=\"2\"/><text x=\"{:.1}\" y=\"{row:.1}\">{} ~ n<tspan dy=\"-5\" font-size=\"10\">{slope:.2}</tspan></text>",
            row - 4.0,
            at + 22.0,
            row - 4.0,
            at + 28.0,
            algorithm.title
        ));
    }
    line("</svg>".into());
    svg
}

fn measure(folder: &Path) -> Result<bool, String> {
    let mut series = Vec::new();
    let mut csv = String::from("algorithm,n,instructions_per_call\n");
    println!("Instructions per call (callgrind), chains of n links, s = {UNKNOWN_NODES}\n");
    let head: Vec<String> = SIZES.iter().map(|n| format!("n = {n}")).collect();
    println!("| algorithm | {} | exponent | last doubling | bar |", head.join(" | "));
    println!("|---|{}---|---|---|", "---|".repeat(SIZES.len()));
    let mut kept = true;
    for algorithm in &ALGORITHMS {
        let mut counts = Vec::new();
        let sizes: Vec<usize> = SIZES.into_iter().filter(|&n| n <= algorithm.longest).collect();
        for &n in &sizes {
            let few = algorithm.repeats / 2;
            let difference =
                instructions(algorithm.key, n, algorithm.repeats)? - instructions(algorithm.key, n, few)?;
            let count = difference as f64 / (algorithm.repeats - few) as f64;
            let _ = writeln!(csv, "{},{n},{count:.0}", algorithm.key);
            counts.push(count);
        }
        let slope = exponent(&sizes, &counts);
        let end = sizes.len() - 2;
        let last = exponent(&sizes[end..], &counts[end..]);
        let within = algorithm.bar.is_none_or(|bar| slope <= bar);
        kept &= within;
        let bar = algorithm
            .bar
            .map_or(String::new(), |bar| format!("<= {bar}{}", if within { "" } else { ": **broken**" }));
        let mut cells: Vec<String> = counts.iter().map(|&c| thousands(c)).collect();
        cells.resize(SIZES.len(), String::new());
        println!("| {} | {} | {slope:.3} | {last:.3} | {bar} |", algorithm.title, cells.join(" | "));
        series.push((algorithm, counts, slope));
    }
    std::fs::create_dir_all(folder).map_err(|e| format!("{}: {e}", folder.display()))?;
    for (name, text) in [("complexity.csv", csv), ("complexity.svg", plot(&series))] {
        let path = folder.join(name);
        std::fs::write(&path, text).map_err(|e| format!("{}: {e}", path.display()))?;
        println!("\nwritten: {}", path.display());
    }
    Ok(kept)
}

fn main() -> ExitCode {
    // `cargo bench` adds `--bench`.
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| a != "--bench").collect();
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let number = |text: &str| text.parse().unwrap_or_else(|e| panic!("'{text}' is not a number: {e}"));
    match words.as_slice() {
        ["--count", algorithm, n, repeats] => run(algorithm, number(n), number(repeats)),
        ["--profile", what, repeats] => profile(what, number(repeats)),
        [] => {
            let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../runs");
            match measure(&folder) {
                Ok(true) => (),
                Ok(false) => {
                    eprintln!("an exponent is above its bar");
                    return ExitCode::FAILURE;
                }
                Err(reason) => {
                    eprintln!("{reason}");
                    return ExitCode::FAILURE;
                }
            }
        }
        _ => {
            eprintln!("usage: complexity [--count ALGORITHM N REPEATS | --profile step|linearize REPEATS]");
            return ExitCode::FAILURE;
        }
    }
    ExitCode::SUCCESS
}
