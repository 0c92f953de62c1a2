//! A link that delivers wrong messages.

use crate::{Corrupt, LinkError, Schedule, SplitMix64, Subscriber};

/// What is wrong with a struck message.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Fault {
    /// The message before it is delivered again instead. Nothing, if there was none.
    Repeated,
    /// Its times are this much too old (ns).
    Stale {
        /// How much.
        age_ns: u32,
    },
    /// Its times are this far in the future (ns).
    Future {
        /// How far.
        ahead_ns: u32,
    },
    /// One number is NaN.
    NotANumber,
    /// One number is infinite.
    Infinite,
    /// One number is 1e300.
    Huge,
    /// It is no message of this type.
    WrongMagic,
    /// It has the next version.
    WrongVersion,
    /// It is about other joints.
    WrongJointSet,
    /// It is about one joint more.
    WrongJointCount,
}

impl Fault {
    /// All kinds, with times of one second.
    pub const ALL: [Self; 10] = [
        Self::Repeated,
        Self::Stale { age_ns: 1_000_000_000 },
        Self::Future { ahead_ns: 1_000_000_000 },
        Self::NotANumber,
        Self::Infinite,
        Self::Huge,
        Self::WrongMagic,
        Self::WrongVersion,
        Self::WrongJointSet,
        Self::WrongJointCount,
    ];
}

/// Damages the messages its [`Schedule`] strikes, at the receiving end of a link. Which number of a message is damaged follows from the
/// seed. Messages are counted as they arrive.
#[derive(Debug)]
pub struct FaultInjector<T, S> {
    link: S,
    fault: Fault,
    schedule: Schedule,
    random: SplitMix64,
    /// The last message that passed undamaged, once there is one.
    intact: Box<T>,
    has_intact: bool,
    delivered: Box<T>,
    injected: u64,
}

impl<T: Corrupt, S: Subscriber<T>> FaultInjector<T, S> {
    /// Wraps the receiving end of a link.
    pub fn new(link: S, fault: Fault, schedule: Schedule, seed: u64) -> Self {
        Self {
            link,
            fault,
            schedule,
            random: SplitMix64::new(seed),
            intact: Box::new(T::zeroed()),
            has_intact: false,
            delivered: Box::new(T::zeroed()),
            injected: 0,
        }
    }

    /// Messages damaged so far.
    pub fn injected(&self) -> u64 {
        self.injected
    }
}

impl<T: Corrupt, S: Subscriber<T>> Subscriber<T> for FaultInjector<T, S> {
    fn receive_latest(&mut self) -> Result<Option<&T>, LinkError> {
        let Some(message) = self.link.receive_latest()? else {
            return Ok(None);
        };
        *self.delivered = *message;
        if !self.schedule.strikes() {
            *self.intact = *message;
            self.has_intact = true;
            return Ok(Some(&self.delivered));
        }
        self.injected += 1;
        if self.fault != Fault::Repeated {
            damage(self.delivered.as_mut(), self.fault, self.random.next_u64());
            return Ok(Some(&self.delivered));
        }
        *self.delivered = *self.intact;
        Ok(Some(&*self.delivered).filter(|_| self.has_intact))
    }
}

fn damage<T: Corrupt>(message: &mut T, fault: Fault, choice: u64) {
    match fault {
        Fault::Repeated => {}
        Fault::Stale { age_ns } => message.shift_time(-i64::from(age_ns)),
        Fault::Future { ahead_ns } => message.shift_time(i64::from(ahead_ns)),
        Fault::NotANumber => message.set_number(choice, f64::NAN),
        Fault::Infinite => message.set_number(choice, f64::INFINITY),
        Fault::Huge => message.set_number(choice, 1e300),
        Fault::WrongMagic => message.header_mut().magic = !T::MAGIC,
        Fault::WrongVersion => message.header_mut().version = T::VERSION + 1,
        Fault::WrongJointSet => message.header_mut().joint_set_hash ^= 1,
        Fault::WrongJointCount => message.add_joint(),
    }
}
