//! What a setting out of range is called, by whichever stage finds it.

/// A setting whose value cannot be used.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SettingError {
    /// The key within the stage's own table.
    pub key: &'static str,
    /// What is wrong, with the value and the range.
    pub cause: String,
}

impl SettingError {
    /// Refuses `value` unless it lies in `range`.
    ///
    /// # Errors
    /// The value lies outside, or is not a number.
    pub fn unless_in<T: PartialOrd + std::fmt::Display>(
        key: &'static str,
        value: T,
        range: std::ops::RangeInclusive<T>,
    ) -> Result<(), Self> {
        if range.contains(&value) {
            return Ok(());
        }
        Err(Self {
            key,
            cause: format!(
                "must be from {} to {}, but is {value}",
                range.start(),
                range.end()
            ),
        })
    }
}
