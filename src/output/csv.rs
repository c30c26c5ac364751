//! Estimates in, the odometry CSV out; and the odometry CSV in, rows out.
//!
//! One header line, then one row a stereo pair, lost ones included. Numbers are the shortest text
//! that reads back as the same bits. `latency_ms` is `nan` where it is no property of the data, as
//! in a replay, whose output is to be the same to the byte on every machine.

use super::number::push_f64;
use super::row::{OdometryRow, Value, from_upper_triangle, isometry};
use crate::capture::MAX_STAMP_NS;
use crate::estimation::{Axes, Counts, Odometry, Status};
use crate::text_file::shown;
use std::fmt::Write as _;
use std::fs::File;
use std::io::{self, BufWriter, Read, Write};
use std::path::{Path, PathBuf};

/// Columns that a file must have.
const REQUIRED: usize = 66;

/// The columns, in order; those from `epoch` on may be missing in a file.
#[rustfmt::skip]
pub const HEADER: [&str; 94] = [
    "seq", "timestamp_ns", "status",
    "tx", "ty", "tz", "qx", "qy", "qz", "qw",
    "c00", "c01", "c02", "c03", "c04", "c05", "c11", "c12", "c13", "c14", "c15",
    "c22", "c23", "c24", "c25", "c33", "c34", "c35", "c44", "c45", "c55",
    "mtx", "mty", "mtz", "mqx", "mqy", "mqz", "mqw",
    "m00", "m01", "m02", "m03", "m04", "m05", "m11", "m12", "m13", "m14", "m15",
    "m22", "m23", "m24", "m25", "m33", "m34", "m35", "m44", "m45", "m55",
    "keypoints_left", "keypoints_right", "stereo_matches", "tracks", "inliers",
    "variance_factor", "latency_ms",
    "epoch", "innovation_ratio",
    "sigma_detection_x", "sigma_detection_y", "sigma_detection_z",
    "sigma_detection_rx", "sigma_detection_ry", "sigma_detection_rz",
    "sigma_calibration_x", "sigma_calibration_y", "sigma_calibration_z",
    "sigma_calibration_rx", "sigma_calibration_ry", "sigma_calibration_rz",
    "sigma_synchronisation_x", "sigma_synchronisation_y", "sigma_synchronisation_z",
    "sigma_synchronisation_rx", "sigma_synchronisation_ry", "sigma_synchronisation_rz",
    "sigma_bridging_x", "sigma_bridging_y", "sigma_bridging_z",
    "sigma_bridging_rx", "sigma_bridging_ry", "sigma_bridging_rz",
    "first_order", "undetermined",
];

/// The header line, without its end.
#[must_use]
pub fn header_line() -> String {
    HEADER.join(",")
}

/// Appends a row, without its end.
pub fn push_row(line: &mut String, row: &OdometryRow) {
    let mut separator = "";
    row.for_each(|_, value| {
        line.push_str(separator);
        separator = ",";
        match value {
            Value::Word(word) => line.push_str(word),
            Value::Float(number) => push_f64(line, number),
            // Writing to a `String` cannot fail.
            Value::Integer(number) => drop(write!(line, "{number}")),
        }
    });
}

/// Writes an odometry CSV; [`finish`](Self::finish) says whether all of it arrived.
pub struct OdometryCsvWriter<W: Write> {
    out: BufWriter<W>,
    line: String,
}

impl OdometryCsvWriter<File> {
    /// Creates or empties a file and writes the header.
    ///
    /// # Errors
    /// The file cannot be created or written.
    pub fn create(path: &Path) -> io::Result<Self> {
        Self::new(File::create(path)?)
    }
}

impl<W: Write> OdometryCsvWriter<W> {
    /// Writes the header to `out`.
    ///
    /// # Errors
    /// `out` cannot be written to.
    pub fn new(out: W) -> io::Result<Self> {
        let mut out = BufWriter::new(out);
        writeln!(out, "{}", header_line())?;
        let line = String::with_capacity(2048);
        Ok(Self { out, line })
    }

    /// Writes the row of an estimate.
    ///
    /// # Errors
    /// The output cannot be written to.
    pub fn write(&mut self, odometry: &Odometry, latency_ms: Option<f64>) -> io::Result<()> {
        self.write_row(&OdometryRow::new(odometry, latency_ms))
    }

    /// Writes a row.
    ///
    /// # Errors
    /// The output cannot be written to.
    pub fn write_row(&mut self, row: &OdometryRow) -> io::Result<()> {
        self.line.clear();
        push_row(&mut self.line, row);
        self.line.push('\n');
        self.out.write_all(self.line.as_bytes())
    }

    /// Hands on what is still buffered. Dropping does so too, but cannot say whether it worked.
    ///
    /// # Errors
    /// The output cannot be written to.
    pub fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }

    /// Ends the file.
    ///
    /// # Errors
    /// What was still buffered cannot be written.
    pub fn finish(mut self) -> io::Result<()> {
        self.out.flush()
    }
}

/// What is wrong with an odometry CSV, and where.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CsvError {
    /// The file.
    pub file: PathBuf,
    /// The line, counted from 1, where there is one.
    pub line: Option<u64>,
    /// The column's name, where there is one.
    pub column: Option<String>,
    /// The cause.
    pub cause: String,
}

impl std::fmt::Display for CsvError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}", self.file.display())?;
        if let Some(line) = self.line {
            write!(f, ":{line}")?;
        }
        if let Some(column) = &self.column {
            write!(f, ": {column}")?;
        }
        write!(f, ": {}", self.cause)
    }
}

impl std::error::Error for CsvError {}

/// Longest file that is read, bytes: two hours of rows at a hundred a second.
const MAX_BYTES: u64 = 1 << 30;

/// Reads an odometry CSV. Columns are found by name, so more may be there, in any order.
///
/// # Errors
/// [`CsvError`]: the file cannot be read, lacks a column, or holds a value that cannot be.
pub fn read_odometry_csv(path: &Path) -> Result<Vec<OdometryRow>, CsvError> {
    let wrong = |cause| CsvError {
        file: path.to_owned(),
        line: None,
        column: None,
        cause,
    };
    let file = File::open(path).map_err(|e| wrong(format!("cannot be read: {e}")))?;
    let length = file.metadata().map_or(0, |meta| meta.len());
    if length > MAX_BYTES {
        return Err(wrong(format!("has {length} bytes, more than {MAX_BYTES}")));
    }
    // What is no file has no length, and perhaps no end.
    parse_odometry_csv(path, file.take(MAX_BYTES))
}

/// Reads an odometry CSV from anywhere, under a name for messages.
///
/// # Errors
/// As [`read_odometry_csv`].
pub fn parse_odometry_csv(name: &Path, input: impl Read) -> Result<Vec<OdometryRow>, CsvError> {
    let mut reader = ::csv::ReaderBuilder::new()
        .trim(::csv::Trim::All)
        .flexible(true)
        .from_reader(input);
    let header = reader.headers().map_err(|e| unreadable(name, &e))?.clone();
    let columns = locate_columns(name, &header)?;
    let mut rows = Vec::new();
    for record in reader.records() {
        let record = record.map_err(|e| unreadable(name, &e))?;
        let line = Record {
            name,
            record: &record,
            columns: &columns,
            fields: header.len(),
        };
        rows.push(line.row()?);
    }
    Ok(rows)
}

fn unreadable(name: &Path, error: &::csv::Error) -> CsvError {
    let cause = match error.kind() {
        ::csv::ErrorKind::Io(e) => format!("cannot be read: {e}"),
        ::csv::ErrorKind::Utf8 { .. } => "is not text in UTF-8".to_owned(),
        _ => error.to_string(),
    };
    CsvError {
        file: name.to_owned(),
        line: error.position().map(::csv::Position::line),
        column: None,
        cause,
    }
}

/// Where each column of [`HEADER`] stands in this file.
fn locate_columns(
    name: &Path,
    header: &::csv::StringRecord,
) -> Result<[Option<usize>; HEADER.len()], CsvError> {
    let columns = HEADER.map(|wanted| header.iter().position(|found| found == wanted));
    match columns.iter().take(REQUIRED).position(Option::is_none) {
        None => Ok(columns),
        Some(missing) => Err(CsvError {
            file: name.to_owned(),
            line: Some(1),
            column: Some(HEADER[missing].to_owned()),
            cause: "is missing from the header of an odometry CSV".to_owned(),
        }),
    }
}

/// A line of the file.
struct Record<'a> {
    name: &'a Path,
    record: &'a ::csv::StringRecord,
    columns: &'a [Option<usize>; HEADER.len()],
    /// How many fields the header has.
    fields: usize,
}

impl Record<'_> {
    fn row(&self) -> Result<OdometryRow, CsvError> {
        if self.record.len() != self.fields {
            let cause = format!(
                "has {} fields, but the header has {}",
                self.record.len(),
                self.fields
            );
            return Err(self.wrong(None, cause));
        }
        let latency_ms: f64 = self.number(65)?;
        Ok(OdometryRow {
            sequence: self.parse(0, "a whole number")?,
            timestamp_ns: self.stamp_ns(1)?,
            status: self.status(2)?,
            odom_from_camera: self.pose(3)?,
            cov_pose: from_upper_triangle(&self.finite_numbers(10)?),
            prev_from_now: self.pose(31)?,
            cov_motion: from_upper_triangle(&self.finite_numbers(38)?),
            counts: Counts {
                keypoints_left: self.parse(59, "a count")?,
                keypoints_right: self.parse(60, "a count")?,
                stereo_matches: self.parse(61, "a count")?,
                tracks: self.parse(62, "a count")?,
                inliers: self.parse(63, "a count")?,
            },
            variance_factor: self.number(64)?,
            latency_ms: (!latency_ms.is_nan()).then_some(latency_ms),
            epoch: match self.columns[66] {
                Some(_) => self.parse(66, "a whole number")?,
                None => 0,
            },
            innovation_ratio: match self.columns[67] {
                Some(_) => self.number(67)?,
                None => f64::NAN,
            },
            budget_sigmas: if (68..92).all(|column| self.columns[column].is_some()) {
                self.finite_numbers(68)?
            } else {
                [0.0; 24]
            },
            is_first_order: match self.columns[92] {
                Some(_) => self.parse::<u8>(92, "0 or 1")? != 0,
                None => true,
            },
            undetermined: self.undetermined(93)?,
        })
    }

    fn undetermined(&self, column: usize) -> Result<Axes, CsvError> {
        if self.columns[column].is_none() {
            return Ok(Axes::NONE);
        }
        let what = "a whole number from 0 to 63";
        Axes::from_bits(self.parse(column, what)?).ok_or_else(|| {
            let text = shown(self.text(column));
            self.wrong(Some(column), format!("must be {what}, but is '{text}'"))
        })
    }

    fn text(&self, column: usize) -> &str {
        self.columns[column]
            .and_then(|i| self.record.get(i))
            .unwrap_or("")
    }

    fn parse<T: std::str::FromStr>(&self, column: usize, what: &str) -> Result<T, CsvError> {
        let text = self.text(column);
        text.parse().map_err(|_| {
            self.wrong(
                Some(column),
                format!("must be {what}, but is '{}'", shown(text)),
            )
        })
    }

    fn stamp_ns(&self, column: usize) -> Result<i64, CsvError> {
        let ns: i64 = self.parse(column, "a whole number of nanoseconds")?;
        if ns.unsigned_abs() < MAX_STAMP_NS.unsigned_abs() {
            return Ok(ns);
        }
        let cause = format!("must lie within ±{MAX_STAMP_NS} ns, but is {ns}");
        Err(self.wrong(Some(column), cause))
    }

    /// Any number, `nan` and infinities included.
    fn number(&self, column: usize) -> Result<f64, CsvError> {
        self.parse(column, "a number")
    }

    fn finite_numbers<const N: usize>(&self, first: usize) -> Result<[f64; N], CsvError> {
        let mut numbers = [0.0; N];
        for (column, number) in (first..).zip(&mut numbers) {
            *number = self.number(column)?;
            if !number.is_finite() {
                let cause = format!("must be finite, but is {number}");
                return Err(self.wrong(Some(column), cause));
            }
        }
        Ok(numbers)
    }

    fn pose(&self, first: usize) -> Result<nalgebra::Isometry3<f64>, CsvError> {
        let translation_m = self.finite_numbers(first)?;
        let xyzw: [f64; 4] = self.finite_numbers(first + 3)?;
        let norm = xyzw.iter().map(|v| v * v).sum::<f64>().sqrt();
        if (norm - 1.0).abs() > 1e-6 {
            let cause = format!("begins a quaternion of length {norm}, which must be 1");
            return Err(self.wrong(Some(first + 3), cause));
        }
        Ok(isometry(translation_m, xyzw))
    }

    fn status(&self, column: usize) -> Result<Status, CsvError> {
        match self.text(column) {
            "initializing" => Ok(Status::Initializing),
            "tracking" => Ok(Status::Tracking),
            "degraded" => Ok(Status::Degraded),
            "lost" => Ok(Status::Lost),
            other => Err(self.wrong(
                Some(column),
                format!(
                    "must be initializing, tracking, degraded or lost, but is '{}'",
                    shown(other)
                ),
            )),
        }
    }

    fn wrong(&self, column: Option<usize>, cause: String) -> CsvError {
        CsvError {
            file: self.name.to_owned(),
            line: self.record.position().map(::csv::Position::line),
            column: column.map(|c| HEADER[c].to_owned()),
            cause,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::row::tests::{any_odometry, sample_odometry};
    use proptest::prelude::*;

    fn written(rows: &[OdometryRow]) -> String {
        let mut bytes = Vec::new();
        let mut writer = OdometryCsvWriter::new(&mut bytes).unwrap();
        rows.iter().for_each(|row| writer.write_row(row).unwrap());
        writer.finish().unwrap();
        String::from_utf8(bytes).unwrap()
    }

    fn read(text: &str) -> Result<Vec<OdometryRow>, CsvError> {
        parse_odometry_csv(Path::new("o.csv"), text.as_bytes())
    }

    /// Every number of a row as bits, since `-0.0 == 0.0` would hide a lost sign.
    fn bits(row: &OdometryRow) -> Vec<(String, String)> {
        let mut all = Vec::new();
        row.for_each(|name, value| {
            let text = match value {
                Value::Float(v) => format!("{:016x}", v.to_bits()),
                other => format!("{other:?}"),
            };
            all.push((name.to_owned(), text));
        });
        all
    }

    proptest! {
        #[test]
        fn what_is_written_reads_back_bit_for_bit(
            odometry in any_odometry(),
            latency_ms in prop::option::of(0.0..1e4_f64),
        ) {
            let row = OdometryRow::new(&odometry, latency_ms);
            let text = written(std::slice::from_ref(&row));
            let back = read(&text).unwrap();
            prop_assert_eq!(back.len(), 1);
            prop_assert_eq!(bits(&back[0]), bits(&row));
            prop_assert_eq!(written(&back), text);
        }
    }

    #[test]
    fn header_is_the_one_that_others_rely_on() {
        let expected = "seq,timestamp_ns,status,tx,ty,tz,qx,qy,qz,qw,\
            c00,c01,c02,c03,c04,c05,c11,c12,c13,c14,c15,c22,c23,c24,c25,c33,c34,c35,c44,c45,c55,\
            mtx,mty,mtz,mqx,mqy,mqz,mqw,\
            m00,m01,m02,m03,m04,m05,m11,m12,m13,m14,m15,m22,m23,m24,m25,m33,m34,m35,m44,m45,m55,\
            keypoints_left,keypoints_right,stereo_matches,tracks,inliers,variance_factor,\
            latency_ms,epoch,innovation_ratio,\
            sigma_detection_x,sigma_detection_y,sigma_detection_z,sigma_detection_rx,sigma_detection_ry,sigma_detection_rz,\
            sigma_calibration_x,sigma_calibration_y,sigma_calibration_z,sigma_calibration_rx,sigma_calibration_ry,sigma_calibration_rz,\
            sigma_synchronisation_x,sigma_synchronisation_y,sigma_synchronisation_z,sigma_synchronisation_rx,sigma_synchronisation_ry,sigma_synchronisation_rz,\
            sigma_bridging_x,sigma_bridging_y,sigma_bridging_z,sigma_bridging_rx,sigma_bridging_ry,sigma_bridging_rz,\
            first_order,undetermined";
        assert_eq!(header_line(), expected);
        let mut names = Vec::new();
        OdometryRow::new(&sample_odometry(0), None).for_each(|name, _| names.push(name.to_owned()));
        assert_eq!(names, HEADER);
    }

    #[test]
    fn other_columns_and_another_order_do_no_harm() {
        let row = OdometryRow::new(&sample_odometry(4), Some(2.5));
        let text = written(std::slice::from_ref(&row));
        let reversed: String = text
            .lines()
            .enumerate()
            .map(|(i, line)| {
                let fields: Vec<_> = line.split(',').rev().collect();
                let extra = if i == 0 { "more" } else { "x" };
                format!("{extra},{}\r\n", fields.join(","))
            })
            .collect();
        assert_eq!(read(&reversed).unwrap(), [row]);
    }

    #[test]
    fn mistakes_are_named_with_line_and_column() {
        let rows: Vec<_> = (0..3)
            .map(|i| OdometryRow::new(&sample_odometry(i), None))
            .collect();
        let text = written(&rows);
        let message = |text: &str| read(text).unwrap_err().to_string();
        assert_eq!(
            message(&text.replacen("c23", "c32", 1)),
            "o.csv:1: c23: is missing from the header of an odometry CSV"
        );
        assert_eq!(
            message(&text.replace("\n2,", "\ntwo,")),
            "o.csv:4: seq: must be a whole number, but is 'two'"
        );
        assert_eq!(
            message(&text.replacen(",tracking,", ",walking,", 1)),
            "o.csv:2: status: must be initializing, tracking, degraded or lost, but is 'walking'"
        );
        assert_eq!(
            message(&text.replacen(",tracking,0.1,", ",tracking,inf,", 1)),
            "o.csv:3: tx: must be finite, but is inf"
        );
        assert_eq!(
            message(text.trim_end().rsplit_once(',').unwrap().0),
            "o.csv:4: has 93 fields, but the header has 94"
        );
        assert!(message("").contains("o.csv:1: seq: is missing"));
        assert!(
            read_odometry_csv(Path::new("/nowhere/o.csv"))
                .unwrap_err()
                .to_string()
                .starts_with("/nowhere/o.csv: cannot be read: ")
        );
    }

    #[test]
    fn a_disk_that_is_full_is_told() {
        let full = File::options().write(true).open("/dev/full").unwrap();
        let mut writer = OdometryCsvWriter::new(full).unwrap();
        writer.write(&sample_odometry(0), None).unwrap();
        assert!(writer.finish().is_err());
    }
}
