//! The command `delmpc`: its parts as a library, so that tests can use them without a terminal.
//!
//! One file per subcommand ([`run`], [`plant`], [`controller`], [`model`], [`mod@check`], [`replay`], [`push_map`],
//! [`mod@report`]); what they share:
//!
//! | file | what it does |
//! |---|---|
//! | [`cli`] | arguments |
//! | [`verdict`] | how a command ends: exit status and message |
//! | [`output`] | what is written to terminals and pipes |
//! | [`input_file`] | files that are given to us |
//! | [`setup`] | scenario and robot from their files, checked against each other |
//! | [`simulated_robot`], [`robot_controller`] | plant and controller made from a setup |
//! | [`board_robot`], [`board`] | a robot as a board has it; a board in the place of the controller |
//! | [`faults`] | faults of messages on purpose |
//! | [`run_folder`] | the folder a run leaves behind |
//! | [`support`] | the hull of the feet, and what an inverted pendulum on it survives |
//! | [`supervisor`] | starts, watches and ends the two processes |
//! | [`part`] | what the two processes have in common |
//! | [`plant_process`] | the loop of the plant process |
//! | [`one_process`] | both loops in one process |
//! | [`truth`], [`observer`], [`metrics`], [`sole`] | what happened, and the figures made of it |
//! | [`summary`], [`summary_table`] | all figures and success; the same as a person reads them |
//! | [`colour`] | colours on a terminal |
//! | [`stance`] | how a robot stands in its postures, for the table of `delmpc model` |
//! | [`check`] | everything that a run would refuse, all at once |
//! | [`mod@init`] | companion table and scenario of a robot that has none |
//! | [`mesh_file`] | mesh files of a robot, found and read |
//! | [`drawing`] | a robot in its postures as SVG |
//! | [`mod@keys`] | every key of a scenario, from the types that read it |
//! | [`completions`] | what a shell needs to complete our words |
//! | [`log_ros`] | transforms and joint states as ROS 2 has them |
//! | [`log`], [`log_viewer`] | the log of states, commands and truth, and what shows the robot to viewers of logs |
//! | [`log_queue`], [`log_file`], [`log_command`], [`log_reader`] | its way to the file, the file, commands in it, and its way back |
//! | [`mod@report`] | the run to look at: `report.html` and pictures of the key plots |
//! | [`connection`] | what a process that is not ours needs to know of a run |
//! | [`foreign_plant`], [`foreign_truth`] | a plant of somebody else's: log, figures and verdict of what it tells |
//! | [`foreign_controller`] | a controller of somebody else's: its commands counted |
//! | [`wire`] | the messages as a page and as JSON, from the types |
//! | [`mod@plant_check`] | the duties of a plant of somebody else's, one by one |
//! | [`steering`] | what a person does to a running plant |
//! | [`view`] | the live page: watch, pull, pause |
//! | [`tape`] | everything that enters the cycles of a run, kept, and given again |
//! | [`timing`] | the timing of the loop certified: figures, causes of missed deadlines, verdict |
//! | [`mod@plan`] | a motion planned through contact, or a plan file checked |
//! | [`status_line`] | one line about the running run |

pub mod board;
pub mod board_robot;
pub mod check;
pub mod cli;
pub mod colour;
pub mod completions;
pub mod connection;
pub mod controller;
pub mod drawing;
pub mod faults;
pub mod foreign_controller;
pub mod foreign_plant;
pub mod foreign_truth;
pub mod init;
pub mod input_file;
pub mod keys;
pub mod legged_metrics;
pub mod legged_robot;
pub mod log;
pub mod log_command;
pub mod log_file;
pub mod log_queue;
pub mod log_reader;
pub mod log_ros;
mod log_schema;
pub mod log_viewer;
pub mod mesh_file;
pub mod metrics;
pub mod model;
mod model_table;
pub mod observer;
pub mod one_process;
pub mod output;
pub mod output_file;
pub mod part;
pub mod plan;
pub mod plan_page;
pub mod plan_source;
pub mod plan_task;
pub mod planned_walk;
pub mod plant;
pub mod plant_check;
pub mod plant_process;
pub mod push_map;
pub mod replay;
pub mod report;
pub mod robot_controller;
pub mod run;
pub mod run_folder;
pub mod setup;
pub mod simulated_robot;
pub mod sole;
pub mod stance;
pub mod start;
pub mod status_line;
pub mod steering;
pub mod summary;
pub mod summary_table;
pub mod supervisor;
pub mod support;
pub mod tape;
pub mod timing;
pub mod truth;
pub mod verdict;
pub mod view;
pub mod wire;
