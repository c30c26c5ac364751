//! Numbers in, text out: the one way in which CSV, JSON and TUM write them.

use std::fmt::Write;

/// Appends the shortest text that reads back as the same 64 bits, e.g. `0.1`, `-2.0`, `1e-7`.
///
/// Infinities are `inf` and `-inf`; what is not a number is `nan`, whatever its sign and payload.
pub fn push_f64(text: &mut String, value: f64) {
    if value.is_nan() {
        text.push_str("nan");
    } else {
        // Writing to a `String` cannot fail.
        let _ = write!(text, "{value:?}");
    }
}

/// As [`push_f64`], but what JSON has no number for is `null`.
pub fn push_json_f64(text: &mut String, value: f64) {
    if value.is_finite() {
        push_f64(text, value);
    } else {
        text.push_str("null");
    }
}

/// Appends nanoseconds as seconds with nine decimals, exactly.
pub fn push_seconds(text: &mut String, ns: i64) {
    const NS_PER_S: u64 = 1_000_000_000;
    let sign = if ns < 0 { "-" } else { "" };
    let magnitude = ns.unsigned_abs();
    let _ = write!(
        text,
        "{sign}{}.{:09}",
        magnitude / NS_PER_S,
        magnitude % NS_PER_S
    );
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn text_of(push: impl Fn(&mut String)) -> String {
        let mut text = String::new();
        push(&mut text);
        text
    }

    proptest! {
        #[test]
        fn text_reads_back_as_the_same_bits(bits in any::<u64>()) {
            let value = f64::from_bits(bits);
            let back: f64 = text_of(|t| push_f64(t, value)).parse().unwrap();
            prop_assert!(back.to_bits() == bits || (back.is_nan() && value.is_nan()));
        }

        #[test]
        fn json_reads_back_as_the_same_bits(bits in any::<u64>()) {
            let value = f64::from_bits(bits);
            let text = text_of(|t| push_json_f64(t, value));
            let back: Option<f64> = serde_json::from_str(&text).unwrap();
            prop_assert_eq!(back.map(f64::to_bits), value.is_finite().then_some(bits));
        }

        #[test]
        fn seconds_keep_every_nanosecond(ns in any::<i64>()) {
            let text = text_of(|t| push_seconds(t, ns));
            let back: i64 = text.replace('.', "").parse().unwrap();
            prop_assert_eq!(back, ns);
            prop_assert_eq!(text.len() - text.find('.').unwrap(), 10);
        }
    }

    #[test]
    fn seconds_below_zero_keep_their_sign() {
        assert_eq!(text_of(|t| push_seconds(t, -1)), "-0.000000001");
        assert_eq!(
            text_of(|t| push_seconds(t, i64::MIN)),
            "-9223372036.854775808"
        );
        assert_eq!(
            text_of(|t| push_seconds(t, 1_403_636_579_763_555_584)),
            "1403636579.763555584"
        );
    }
}
