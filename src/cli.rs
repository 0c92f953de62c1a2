//! Arguments of the command.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};

use crate::check::CheckArguments;
use crate::completions::CompletionsArguments;
use crate::init::InitArguments;
use crate::keys::KeysArguments;
use crate::model::ModelArguments;
use crate::plan::PlanArguments;
use crate::plant_check::PlantCheckArguments;
use crate::push_map::PushMapArguments;
use crate::replay::ReplayArguments;
use crate::report::ReportArguments;
use crate::timing::TimingArguments;
use crate::timing::transport::TransportPeerArguments;
use crate::wire::WireArguments;

/// What `--help` shows at its end.
const EXAMPLES: &str = "\
Examples:
  delmpc                                        run the main scenario
  delmpc run --view                             watch it in a browser and pull at the robot
  delmpc run --set seed=7 --set push.impulse_ns=20
  delmpc run configs/scenarios/atlas_one_foot.toml --set clock=lockstep --json
  delmpc model configs/robots/atlas.urdf
  delmpc push-map --controller mpc,static-lqr --directions 8
  delmpc timing --duration 10
  delmpc replay runs/latest --verify
  delmpc help run                               everything about a subcommand

Files:
  configs/scenarios/*.toml     scenarios: what happens, and what counts as success
  configs/robots/NAME.urdf     robots, each with a companion table NAME.toml beside it
  configs/examples/lamp        how to bring your own
  runs/latest                  what the last run left behind

Environment:
  NO_COLOR                     no colours, even on a terminal

Exit status:
  0    success
  1    a success criterion was missed
  2    usage, configuration or model error
  3    fault: a process was lost, a link broke, a file could not be written
  130  interrupted";

const RUN_EXAMPLES: &str = "\
Examples:
  delmpc run                                          the main scenario, in real time
  delmpc run configs/scenarios/atlas_one_foot.toml --out /tmp/try
  delmpc run --set push.impulse_ns=20 --set push.direction=[1,0,0]
  delmpc run --view --set duration_s=60               watch, push with the mouse, pause
  delmpc run --set clock=lockstep                     the same bits every time, as fast as it goes
  delmpc run --json | jq .min_cop_margin_m            one figure
  delmpc run --plant 'python3 examples/mujoco/plant.py' --set clock=lockstep
  delmpc run runs/latest/scenario.toml                a run of yesterday again

The folder of a run:
  report.html                 the run to look at, in one file without network
  plots/*.png                 its key plots
  summary.json                every figure; flat keys, SI units
  log.mcap                    every state, command and truth, for `delmpc replay` and viewers of MCAP
  scenario.toml, robot.*      everything it takes to run it again
  messages.txt                what the two processes said

A scenario key is overridden by its full name, with a value as in TOML: --set reach.ball_m=[0.7,0.2,0.6]. \
An unknown key or a value out of range is refused, with the nearest one allowed.";

const PUSH_MAP_EXAMPLES: &str = "\
Examples:
  delmpc push-map                                        main scenario, 8 directions
  delmpc push-map --controller mpc,static-lqr            against a fixed LQR
  delmpc push-map --link utorso,pelvis --directions 16 --seeds 3   each push with 3 seeds of the noise instead of 6
  delmpc push-map configs/examples/lamp/reach.toml --link upper_arm --json
  delmpc push-map --set sensors.noise_scale=5 --out /tmp/noisy

A push is survived when the robot does not fall, keeps its other foot in the air and comes to rest. \
The limit is the largest impulse below which all seeds survive; beside it the shares that survive at 90, 100, 110 %. \
Beside each limit stands the capture limit: what an inverted pendulum with a massless leg survives in that direction.";

const REPLAY_EXAMPLES: &str = "\
Examples:
  delmpc run --set clock=lockstep && delmpc replay --verify
  delmpc replay /tmp/try --verify";

const PLAN_EXAMPLES: &str = "\
Examples:
  delmpc plan configs/scenarios/flamingo_jump.toml
  delmpc plan configs/scenarios/flamingo_jump.toml --guesses 4 --out /tmp/jump.json
  delmpc plan configs/scenarios/littledog_gaps.toml --set plan.friction=0.6
  delmpc plan --check /tmp/jump.json

Exit status 0 only when the plan converged and every residual, recomputed from the file with the mechanics alone, is within its bound.";

const REPORT_EXAMPLES: &str = "\
Examples:
  delmpc report                                 of the last run
  xdg-open \"$(delmpc report /tmp/try)\"
  for run in runs/*/; do delmpc report \"$run\"; done";

const PART_EXAMPLES: &str = "\
Examples:
  delmpc plant configs/scenarios/atlas_one_foot.toml --out /tmp/try &
  delmpc controller configs/scenarios/atlas_one_foot.toml --out /tmp/try";

const CONTROLLER_EXAMPLES: &str = "\
Examples:
  delmpc controller configs/scenarios/atlas_one_foot.toml --out /tmp/try
  delmpc controller configs/examples/lamp/board.toml --board 127.0.0.1:5555 --out /tmp/try";

const MODEL_EXAMPLES: &str = "\
Examples:
  delmpc model configs/robots/atlas.urdf
  delmpc model configs/robots/atlas.urdf --svg atlas.svg
  delmpc model configs/robots/atlas.urdf --base fixed:r_foot
  delmpc model configs/robots/atlas.urdf --stand left       a posture on the left sole
  echo '{\"q\": {\"r_leg_kny\": 0.9}, \"dt\": 0.005}' > at.json
  delmpc model configs/robots/atlas.urdf --at at.json       A, B, mass matrix, step as JSON";

const INIT_EXAMPLES: &str = "\
Examples:
  delmpc init talos.urdf                        folder talos with talos.urdf, talos.toml, stand.toml
  delmpc init talos.urdf --stand left --out try
  delmpc init talos.urdf --stand both           on both feet
  delmpc init a1.urdf && delmpc run a1/stand.toml --set gait.kind=trot --set gait.speed_m_s=0.3
  delmpc init panda.urdf                        no feet: bolted down, reaches for a ball
  delmpc check talos/stand.toml && delmpc run talos/stand.toml";

const KEYS_EXAMPLES: &str = "\
Examples:
  delmpc keys                                   a page in Markdown
  delmpc keys controller.legged
  delmpc keys --companion
  delmpc keys --schema > scenario.schema.json   for an editor that knows JSON schemas of TOML files";

const WIRE_EXAMPLES: &str = "\
Examples:
  delmpc wire                                   the page, shared/messages/WIRE.md
  delmpc wire --json > wire.json                every payload: field, offset, size, type, unit, frame
  delmpc wire --c > delmpc.h                    for C and C++
  delmpc wire --connection configs/scenarios/atlas_one_foot.toml --run-id bench-3";

const PLANT_CHECK_EXAMPLES: &str = "\
Examples:
  delmpc plant-check 'python3 examples/mujoco/plant.py'
  delmpc plant-check './my_plant' my_robot/stand.toml --json
  delmpc plant-check 'exec delmpc plant $DELMPC_SCENARIO --run-id $DELMPC_RUN_ID --supervised'   our own";

const CHECK_EXAMPLES: &str = "\
Examples:
  delmpc check configs/scenarios/*.toml
  delmpc check my_robot/stand.toml --set sensors.delay_s=0.01
  delmpc check my_robot/robot.urdf --strict";

const TIMING_EXAMPLES: &str = "\
Examples:
  delmpc timing                                       60 s alone and 60 s under co-load, plant on core 0, controller on core 1
  delmpc timing --duration 10 --cores 2,3
  delmpc timing --one-core --set controller.mpc_rate_hz=100
  delmpc timing --no-rt                               without privileges, by the thresholds relative to the floor
  delmpc timing --faults                              every fault of configs/scenarios/atlas_faults.toml";

const COMPLETIONS_EXAMPLES: &str = "\
Examples:
  delmpc completions bash > ~/.local/share/bash-completion/completions/delmpc
  delmpc completions zsh > ~/.zfunc/_delmpc
  delmpc completions fish > ~/.config/fish/completions/delmpc.fish";

/// Whole-body model-predictive control on a variational integrator.
///
/// Without a subcommand the main scenario is run: Atlas stands on one foot, fetches a ball and takes a push, with the plant and the
/// controller as two processes.
#[derive(Debug, Parser)]
#[command(name = "delmpc", version, args_conflicts_with_subcommands = true, after_help = EXAMPLES)]
pub struct Cli {
    /// What to do; nothing: `run`.
    #[command(subcommand)]
    pub command: Option<Command>,
    /// Options of `run`, for the call without a subcommand.
    #[command(flatten)]
    pub options: RunOptions,
}

/// The subcommands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Run a scenario: plant and controller as two processes, watched until they end
    ///
    /// The results are left in a folder: the log (log.mcap), the figures (summary.json), the run to look at (report.html), and the
    /// robot and the effective configuration, with which the run can be run again.
    #[command(after_long_help = RUN_EXAMPLES)]
    Run(RunArguments),
    /// The plant process alone: simulates the robot, waits for a controller of the same scenario
    ///
    /// Whichever process is started first waits for the other one. Both find each other by the scenario, so give both the same
    /// file and the same --set.
    #[command(after_long_help = PART_EXAMPLES)]
    Plant(PartArguments),
    /// The controller process alone: waits for a plant of the same scenario
    ///
    /// Whichever process is started first waits for the other one. Both find each other by the scenario, so give both the same
    /// file and the same --set.
    #[command(after_long_help = CONTROLLER_EXAMPLES)]
    Controller(ControllerArguments),
    /// Check a robot model; print its table, draw it or, with --at, compute everything from it
    ///
    /// The table shows the tree with joints, limits and masses, the names of the companion table, how the robot stands in each of its
    /// postures, and what was accepted but should be known.
    #[command(after_long_help = MODEL_EXAMPLES)]
    Model(ModelArguments),
    /// Make a companion table and a scenario for a robot that has none
    ///
    /// Feet are found from its shapes and mesh files, a posture on one sole, two or four feet is solved by inverse kinematics, weights, noise
    /// and push are those of its size. A robot without feet is bolted down and reaches. Joints that cannot be driven are locked. The files
    /// say what every key means; change them as you like.
    #[command(after_long_help = INIT_EXAMPLES)]
    Init(InitArguments),
    /// Check scenarios, robots and companion tables: everything that `run` would refuse, all at once
    ///
    /// Keys alone and against each other, the robot, names that it must know, posture, torques, controller and plant. Exit status 2 when
    /// there is an error.
    #[command(after_long_help = CHECK_EXAMPLES)]
    Check(CheckArguments),
    /// List every key of scenarios and companion tables: what it takes, its default, what it means; or a JSON schema for editors
    #[command(after_long_help = KEYS_EXAMPLES)]
    Keys(KeysArguments),
    /// Tell what plant and controller say to each other: a page, JSON for other languages, or the description of a run
    ///
    /// For whoever writes another plant or another controller: services, layouts, codes, duties, and what is refused.
    #[command(after_long_help = WIRE_EXAMPLES)]
    Wire(WireArguments),
    /// Put a plant of your own through its duties: start, answers, bounds, bad commands, silence, watchdog, end
    ///
    /// The plant is started as by `delmpc run --plant`, in lockstep, and asked what shared/messages/WIRE.md demands. Exit status 1 when a
    /// duty is not met.
    #[command(after_long_help = PLANT_CHECK_EXAMPLES)]
    PlantCheck(PlantCheckArguments),
    /// Find the largest push survived in every direction: table, JSON, polar plot
    ///
    /// The robot stands in the scenario's posture and is pushed once, in lockstep; the impulse is found by bisection. Left behind are
    /// push_map.json and push_map.svg.
    #[command(after_long_help = PUSH_MAP_EXAMPLES)]
    PushMap(PushMapArguments),
    /// Certify the timing of the loop on two cores: the machine's floor first, then the loop, then the loop under stress
    ///
    /// Every missed deadline is followed to its cause: the machine, or the stage of the software. The thresholds are those of the
    /// scenario; exit status 3 when one is broken. What the operating system does not permit is a warning.
    #[command(after_long_help = TIMING_EXAMPLES)]
    Timing(TimingArguments),
    /// The other end of the transport measurement
    #[command(hide = true)]
    TransportPeer(TransportPeerArguments),
    /// Run again from the log of a run and compare bit by bit
    ///
    /// The plant is given every logged command where it came; each state and truth must come out as logged. In lockstep the
    /// controller is given every logged state, and each command must come out as logged. Of a log that is cut or has a hole, what is
    /// before that is compared, and the time is told.
    #[command(after_long_help = REPLAY_EXAMPLES)]
    Replay(ReplayArguments),
    /// Make report.html and the plots of a run again from its files
    ///
    /// The page is one file and needs no network: an animation of the robot, plots with one cursor, the criteria of the scenario.
    /// The key plots are left as PNG in the folder plots/ beside it. Prints the path of the page.
    #[command(after_long_help = REPORT_EXAMPLES)]
    Report(ReportArguments),
    /// Plan a motion through contact, nobody names who touches when; or check a plan file
    ///
    /// The scenario says robot, ground, way and time in its section `[plan]`. Left behind is a plan file: times, states, torques,
    /// impulses and contact sets at every stage.
    #[command(after_long_help = PLAN_EXAMPLES)]
    Plan(PlanArguments),
    /// Print the script that makes a shell complete our words
    #[command(after_long_help = COMPLETIONS_EXAMPLES)]
    Completions(CompletionsArguments),
}

/// Options of `delmpc run`.
#[derive(Debug, Clone, Default, Args)]
pub struct RunOptions {
    /// Folder of the run, new, empty or of an earlier run [default: runs/SCENARIO-TIME, to which runs/latest then points]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Override a key of the scenario, for example --set plant.friction=0.4; may be given several times
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Print nothing but warnings and errors
    #[arg(long)]
    pub quiet: bool,
    /// Print the summary as one JSON object and nothing else
    #[arg(long)]
    pub json: bool,
    /// Show the run in a browser while it goes on: a page on this machine's loopback, in which one can pull at the robot and pause. The
    /// run begins when the page is opened
    #[arg(long, conflicts_with = "one_process")]
    pub view: bool,
    /// Port of the page [default: a free one]
    #[arg(long, value_name = "PORT", requires = "view", default_value_t = 0, hide_default_value = true)]
    pub port: u16,
    /// Do not write report.html and the plots
    #[arg(long)]
    pub no_report: bool,
    /// Both parts in one process: deterministic, for debugging; needs the lockstep clock
    #[arg(long)]
    pub one_process: bool,
    /// The plant is this command, run by /bin/sh, instead of our simulation: another simulator, a robot
    ///
    /// It finds its run by DELMPC_CONNECTION, a JSON file, and talks the messages of shared/messages/WIRE.md. Log, report and verdict
    /// are as usual.
    #[arg(long, value_name = "COMMAND", conflicts_with_all = ["one_process", "view"])]
    pub plant: Option<String>,
    /// The controller is this command instead of ours, started in the same way
    #[arg(long, value_name = "COMMAND", conflicts_with = "one_process")]
    pub controller: Option<String>,
}

/// Arguments of `delmpc run`.
#[derive(Debug, Clone, Default, Args)]
pub struct RunArguments {
    /// Scenario file [default: configs/scenarios/atlas_one_foot.toml]
    pub scenario: Option<PathBuf>,
    /// Options.
    #[command(flatten)]
    pub options: RunOptions,
}

/// Arguments of the controller process alone.
#[derive(Debug, Clone, Args)]
pub struct ControllerArguments {
    /// Arguments of every process.
    #[command(flatten)]
    pub part: PartArguments,
    /// A board computes the commands, reached at this address; every answer is held against this machine's own
    ///
    /// The board is sent the readings of every plant step and answers with torques, in lockstep: its frames are in
    /// shared/servo/src/wire.rs, its firmware is what `delmpc model --emit rust` and tests/embedded are for. Exit status 1 when an
    /// answer is more than 1e-9 beside what the library gives.
    #[arg(long, value_name = "HOST:PORT", conflicts_with = "timing")]
    pub board: Option<String>,
}

/// Arguments of one process alone.
#[derive(Debug, Clone, Args)]
pub struct PartArguments {
    /// Scenario file
    pub scenario: PathBuf,
    /// Override a key of the scenario; give both processes the same
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Run that the process belongs to: 16 hexadecimal digits, or a name [default: made from the scenario, the same for both]
    #[arg(long, value_name = "ID")]
    pub run_id: Option<String>,
    /// Folder of the run, the same for both: new, empty or of an earlier run. The one that ends last writes summary and report
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// A supervisor starts, watches and ends this process
    #[arg(long, hide = true)]
    pub supervised: bool,
    /// Leave the times of every cycle or step, and no log
    #[arg(long, hide = true, requires = "out")]
    pub timing: bool,
    /// Standard input says what a person does to the plant
    #[arg(long, hide = true)]
    pub steered: bool,
}
