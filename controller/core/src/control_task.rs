//! Control cycle and servo of a robot on one processor: readings in, torque out, at the servo's rate.
//!
//! ```text
//! every servo period     readings --> servo: law of the command in force, watchdog --> torque
//! every control period   readings --> estimator, horizon, QP --> command, for `delay_s` later --> the servo's queue
//! ```
//!
//! [`ControlTask::tick`] does both, one after the other: what a simulation in lockstep and a board without an operating system call. On
//! a board whose cycle takes longer than a servo period the two run at different priorities: the servo in the timer's interrupt, the
//! cycle below it. Then use [`Controller`] and [`Servo`] themselves, with a slot for a command between them; a command is computed
//! within its `delay_s` or is late, and what the servo does then is in `delmpc_servo`.

use alloc::boxed::Box;

use delmpc_lq::active_set_dual::ActiveSetDual;
use delmpc_messages::{Command, FallbackLevel, MAX_JOINTS, PlantState, ServoReadings};
use delmpc_servo::prelude::{Servo, ServoError, WatchdogConfig};

use crate::config::ControllerConfig;
use crate::cycle::{Clock, Controller};
use crate::errors::ControlError;
use crate::model::ControllerModel;

/// Why a task could not be made.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TaskError {
    /// The controller was refused.
    #[error(transparent)]
    Control(#[from] ControlError),
    /// The servo was refused.
    #[error(transparent)]
    Servo(#[from] ServoError),
}

/// Controller and servo of one robot.
#[derive(Debug)]
pub struct ControlTask {
    controller: Controller,
    servo: Servo,
    joints: usize,
    period_ns: u64,
    /// When the next cycle begins, by the robot's clock; `None`: with the next readings.
    next_cycle_ns: Option<u64>,
    command: Command,
    torque: [f64; MAX_JOINTS],
    cycled: bool,
}

impl ControlTask {
    /// Makes controller and servo; takes all memory. The run's time is the robot's: 0 is when its clock shows 0.
    ///
    /// # Errors
    /// [`TaskError`]: what is wrong with model, configuration or watchdog.
    pub fn new(
        model: ControllerModel,
        config: ControllerConfig,
        watchdog: WatchdogConfig,
    ) -> Result<Self, TaskError> {
        Self::of(Controller::new(model, config)?, watchdog)
    }

    /// The same with the QP solver of boards, [`ActiveSetDual`], whatever this build has.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn with_active_set(
        model: ControllerModel,
        config: ControllerConfig,
        watchdog: WatchdogConfig,
    ) -> Result<Self, TaskError> {
        let backend = Box::new(ActiveSetDual::new(config.qp.capacity));
        Self::of(Controller::with_backend(model, config, backend)?, watchdog)
    }

    fn of(mut controller: Controller, watchdog: WatchdogConfig) -> Result<Self, TaskError> {
        let (joints, hash) = (controller.model().tree.dof(), controller.model().joint_set_hash);
        let period_ns = libm::round(controller.config().period_s * 1e9) as u64;
        controller.set_origin_ns(0);
        Ok(Self {
            controller,
            servo: Servo::new(joints, hash, watchdog)?,
            joints,
            period_ns,
            next_cycle_ns: None,
            command: Command::new(0, hash, joints as u32),
            torque: [0.0; MAX_JOINTS],
            cycled: false,
        })
    }

    /// One servo period, then a control cycle when one is due; returns the torque of every joint in the order of the messages. `clock`
    /// times the steps of the cycle for its report. No allocation.
    ///
    /// The servo comes first: what its timer waits for is the torque, and the command whose time has come takes effect before the next
    /// one arrives. So a robot without a command yet is held by the watchdog's law for a servo period.
    pub fn tick(&mut self, readings: &PlantState, clock: &dyn Clock) -> &[f64] {
        let now_ns = readings.time_ns;
        let torque = &mut self.torque[..self.joints];
        if readings.validate(self.command.header.joint_set_hash, self.joints).is_ok() {
            self.servo.torque_into(now_ns, &ServoReadings::of_state(readings), torque);
        } else {
            // No law is right for readings that are damaged.
            torque.fill(0.0);
        }
        self.cycled = self.next_cycle_ns.is_none_or(|due_ns| now_ns >= due_ns);
        if self.cycled {
            let first = self.next_cycle_ns.is_none();
            let next_ns = self.next_cycle_ns.unwrap_or(now_ns).saturating_add(self.period_ns);
            self.next_cycle_ns = Some(next_ns.max(now_ns));
            self.cycle(readings, first, clock);
        }
        &self.torque[..self.joints]
    }

    fn cycle(&mut self, readings: &PlantState, first: bool, clock: &dyn Clock) {
        let sequence = self.command.header.sequence + 1;
        self.command = *self.controller.cycle(readings, readings.time_ns, clock);
        self.command.header.sequence = sequence;
        if first {
            // Nothing else is in force yet.
            self.command.valid_from_ns = readings.time_ns;
        }
        // A command that is refused leaves the one before in force, and the watchdog counts its time.
        let _ = self.servo.accept(&self.command, readings.time_ns);
    }

    /// Whether the last tick had a control cycle.
    pub fn cycled(&self) -> bool {
        self.cycled
    }

    /// The command of the last cycle.
    pub fn command(&self) -> &Command {
        &self.command
    }

    /// The controller.
    pub fn controller(&self) -> &Controller {
        &self.controller
    }

    /// The servo's level at the last tick.
    pub fn level(&self) -> FallbackLevel {
        self.servo.level()
    }

    /// The torque of the last tick.
    pub fn torque(&self) -> &[f64] {
        &self.torque[..self.joints]
    }
}
