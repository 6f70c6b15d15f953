//! The checks all messages share. Messages hold `f32`, so limits are compared as `f32`.

use super::WireError;
use crate::authority::OperatorName;

/// Every value finite and in `low..=high`.
pub(super) fn within(
    field: &'static str,
    values: &[f32],
    low: f32,
    high: f32,
    allowed: &'static str,
) -> Result<(), WireError> {
    match values.iter().position(|value| !(low..=high).contains(value)) {
        None => Ok(()),
        // The range excludes NaN and the infinities too.
        Some(index) => Err(WireError::Value { field, index, value: values[index], allowed }),
    }
}

/// Values beyond a hand's joints or fingers must not carry anything.
pub(super) fn zero(field: &'static str, values: &[f32]) -> Result<(), WireError> {
    within(field, values, 0.0, 0.0, "0 (padding)")
}

pub(super) fn position(field: &'static str, values: &[f32]) -> Result<(), WireError> {
    within(field, values, -10.0, 10.0, "-10 to 10 m")
}

pub(super) fn angle(field: &'static str, values: &[f32]) -> Result<(), WireError> {
    within(field, values, -100.0, 100.0, "-100 to 100 rad")
}

/// A number of things, at most `most`.
pub(super) fn count(
    field: &'static str,
    value: u8,
    least: usize,
    most: usize,
    allowed: &'static str,
) -> Result<usize, WireError> {
    let number = usize::from(value);
    if (least..=most).contains(&number) { Ok(number) } else { Err(WireError::Code { field, value, allowed }) }
}

/// Printable, and zeros after that.
pub(super) fn name(field: &'static str, name: &OperatorName) -> Result<(), WireError> {
    if name.is_valid() { Ok(()) } else { Err(WireError::Name { field }) }
}
