//! Parser of whole numbers for options.
use std::ops::{Bound, RangeBounds};

/// Parses a whole number in a range.
pub fn whole<T: TryFrom<u64>>(
    range: impl RangeBounds<u64> + Clone + Send + Sync + 'static,
) -> impl Fn(&str) -> Result<T, String> + Clone + Send + Sync + 'static {
    move |text| {
        let least = match range.start_bound() {
            Bound::Included(least) => *least,
            _ => 0,
        };
        let give = match range.end_bound() {
            Bound::Included(most) => format!("give {least} to {most}"),
            _ => format!("give {least} or more"),
        };
        let digits = text.strip_prefix(['-', '+']).unwrap_or(text);
        if digits.is_empty() || !digits.bytes().all(|b| b.is_ascii_digit()) {
            return Err(format!("not a whole number; {give}"));
        }
        match text.parse::<u64>() {
            Ok(number) if range.contains(&number) => T::try_from(number).map_err(|_| give),
            Err(_) if !text.starts_with('-') => Err(format!("too large; {give}")),
            _ => Err(give),
        }
    }
}
