//! A message in, one JSON object on one line out, for `visod listen --json`.
//!
//! Keys and numbers of the odometry CSV's columns come first, written by the same function, so that
//! both hold the same text. What JSON has no number for is `null`.

use super::message::OdometryMessage;
use super::number::push_json_f64;
use super::row::{OdometryRow, Value, upper_triangle};
use nalgebra::Matrix6;
use std::fmt::Write;

/// Appends the object, without a line's end; nothing if the message's status is not defined.
///
/// `received_monotonic_ns` is the listener's own clock when the message came.
pub fn push_message(line: &mut String, message: &OdometryMessage, received_monotonic_ns: i64) {
    let Some(row) = OdometryRow::from_message(message) else {
        return;
    };
    line.push('{');
    row.for_each(|name, value| {
        key(line, name);
        match value {
            Value::Word(word) => drop(write!(line, "\"{word}\"")),
            Value::Integer(number) => drop(write!(line, "{number}")),
            Value::Float(number) => push_json_f64(line, number),
        }
    });
    let frame = if message.frame == 0 {
        "left_camera"
    } else {
        "base"
    };
    key(line, "frame");
    let _ = write!(line, "\"{frame}\"");
    key(line, "replay");
    let _ = write!(line, "{}", message.is_replay());
    push_clocks(line, message, received_monotonic_ns);
    key(line, "twist");
    push_numbers(line, &message.twist);
    key(line, "cov_twist");
    push_numbers(
        line,
        &upper_triangle(&Matrix6::from_row_slice(&message.cov_twist)),
    );
    push_budget(line, message);
    push_latencies(line, message);
    line.push('}');
}

fn push_clocks(line: &mut String, message: &OdometryMessage, received_monotonic_ns: i64) {
    for (name, value) in [
        ("message_number", i128::from(message.message_number)),
        ("realtime_ns", message.realtime_ns.into()),
        ("monotonic_ns", message.monotonic_ns.into()),
        (
            "published_monotonic_ns",
            message.published_monotonic_ns.into(),
        ),
        ("received_monotonic_ns", received_monotonic_ns.into()),
    ] {
        key(line, name);
        let _ = write!(line, "{value}");
    }
}

/// Upper triangles by part; a part that is not modelled is `null`, not zero.
fn push_budget(line: &mut String, message: &OdometryMessage) {
    key(line, "budget");
    line.push('{');
    for (name, bit, triangle) in message.budget() {
        key(line, name);
        if message.budget_modelled & bit != 0 {
            push_numbers(line, triangle);
        } else {
            line.push_str("null");
        }
    }
    line.push('}');
}

/// Nanoseconds by stage; one that was not measured is `null`.
fn push_latencies(line: &mut String, message: &OdometryMessage) {
    let latencies = message.latencies();
    key(line, "latencies_ns");
    line.push('{');
    for (name, ns) in [
        ("capture", latencies.capture_ns),
        ("features", latencies.features_ns),
        ("matching", latencies.matching_ns),
        ("estimation", latencies.estimation_ns),
        ("total", latencies.total_ns),
    ] {
        key(line, name);
        if ns > 0 {
            let _ = write!(line, "{ns}");
        } else {
            line.push_str("null");
        }
    }
    line.push('}');
}

fn push_numbers(line: &mut String, numbers: &[f64]) {
    line.push('[');
    for (i, number) in numbers.iter().enumerate() {
        if i > 0 {
            line.push(',');
        }
        push_json_f64(line, *number);
    }
    line.push(']');
}

/// Appends a key, after a comma unless it is an object's first.
fn key(line: &mut String, name: &str) {
    if !line.ends_with('{') {
        line.push(',');
    }
    let _ = write!(line, "\"{name}\":");
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::csv;
    use crate::output::message::{CaptureTime, Latencies};
    use crate::output::row::tests::any_odometry;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(crate::properties::remembered())]

        #[test]
        fn every_column_of_the_csv_has_the_same_text(odometry in any_odometry()) {
            let stamp = CaptureTime::Recorded(odometry.timestamp_ns);
            let message = OdometryMessage::new(&odometry, None, stamp, Latencies::default());
            let mut json = String::new();
            push_message(&mut json, &message, 9);
            let mut row = String::new();
            csv::push_row(&mut row, &OdometryRow::new(&odometry, None));
            for (name, text) in csv::HEADER.iter().zip(row.split(',')) {
                let expected = match (*name, text) {
                    (_, "nan") => format!("\"{name}\":null"),
                    ("status", word) => format!("\"{name}\":\"{word}\""),
                    (_, number) => format!("\"{name}\":{number}"),
                };
                prop_assert!(json.contains(&expected), "{expected} is not in {json}");
            }
            let parsed: serde_json::Value = serde_json::from_str(&json).unwrap();
            prop_assert_eq!(parsed["twist"][5].as_f64(), Some(odometry.twist[5]));
            prop_assert_eq!(
                parsed["budget"]["detection"][20].as_f64(),
                Some(odometry.budget.detection[(5, 5)])
            );
            prop_assert_eq!(
                parsed["budget"]["calibration"][0].as_f64(),
                Some(odometry.budget.calibration[(0, 0)])
            );
            prop_assert!(parsed["latencies_ns"]["total"].is_null());
            prop_assert_eq!(parsed["received_monotonic_ns"].as_i64(), Some(9));
        }
    }
}
