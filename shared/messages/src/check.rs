//! The checks messages share. Each names the field it refuses.

use crate::{LATEST_TIME_NS, MAX_JOINTS, MessageError};

/// A quaternion whose squared length differs more than this from 1 was not normalised.
pub const UNIT_TOLERANCE: f64 = 1e-6;

/// Every value finite and of a magnitude up to `limit`.
pub(crate) fn plausible(
    message: &'static str,
    field: &'static str,
    values: &[f64],
    limit: f64,
) -> Result<(), MessageError> {
    for (index, &value) in values.iter().enumerate() {
        plausible_one(message, field, index, value, limit)?;
    }
    Ok(())
}

/// One value finite and of a magnitude up to `limit`; `index` is only reported.
pub(crate) fn plausible_one(
    message: &'static str,
    field: &'static str,
    index: usize,
    value: f64,
    limit: f64,
) -> Result<(), MessageError> {
    if !value.is_finite() {
        return Err(MessageError::NotFinite { message, field, index, value });
    }
    if value.abs() > limit {
        return Err(MessageError::Implausible { message, field, index, value, limit });
    }
    Ok(())
}

/// A time that a clock may show.
pub(crate) fn time(message: &'static str, field: &'static str, time_ns: u64) -> Result<(), MessageError> {
    let limit_ns = LATEST_TIME_NS;
    if time_ns > limit_ns {
        return Err(MessageError::TimeBeyond { message, field, time_ns, limit_ns });
    }
    Ok(())
}

/// A quaternion of unit length.
pub(crate) fn unit_quaternion(
    message: &'static str,
    field: &'static str,
    xyzw: &[f64; 4],
) -> Result<(), MessageError> {
    plausible(message, field, xyzw, 2.0)?;
    let squared_norm: f64 = xyzw.iter().map(|x| x * x).sum();
    if (squared_norm - 1.0).abs() > UNIT_TOLERANCE {
        return Err(MessageError::NotUnit { message, field, squared_norm, tolerance: UNIT_TOLERANCE });
    }
    Ok(())
}

/// The joint count of the message equals ours and fits; returns it as an index bound.
pub(crate) fn joint_count(message: &'static str, found: u32, expected: usize) -> Result<usize, MessageError> {
    let found = found as usize;
    if found != expected || found > MAX_JOINTS {
        return Err(MessageError::WrongJointCount { message, found, expected });
    }
    Ok(found)
}

/// A code that was understood, or the error that names it.
pub(crate) fn known<T>(
    message: &'static str,
    field: &'static str,
    value: u32,
    understood: Option<T>,
) -> Result<T, MessageError> {
    understood.ok_or(MessageError::UnknownCode { message, field, value })
}
