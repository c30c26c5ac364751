//! `visod report` as a user runs it.

use nalgebra::{Isometry3, Matrix6};
use std::path::Path;
use std::process::{Command, Output};
use visod::estimation::{Axes, Counts, Status};
use visod::output::csv::OdometryCsvWriter;
use visod::output::row::OdometryRow;

fn write_odometry(path: &Path, count: u64) {
    let mut writer = OdometryCsvWriter::create(path).unwrap();
    for sequence in 0..count {
        let row = OdometryRow {
            sequence,
            timestamp_ns: sequence as i64 * 100_000_000,
            status: match sequence {
                0 => Status::Initializing,
                _ => Status::Tracking,
            },
            odom_from_camera: Isometry3::translation(0.0, 0.0, sequence as f64),
            cov_pose: Matrix6::identity() * (1e-4 * sequence as f64),
            prev_from_now: Isometry3::translation(0.0, 0.0, 1.0),
            cov_motion: Matrix6::identity() * 1e-4,
            counts: Counts::default(),
            variance_factor: f64::NAN,
            latency_ms: None,
            epoch: 0,
            innovation_ratio: f64::NAN,
            budget_sigmas: std::array::from_fn(|i| 1e-4 * ((i % 5) as f64)),
            is_first_order: true,
            undetermined: Axes::NONE,
        };
        writer.write_row(&row).unwrap();
    }
    writer.finish().unwrap();
}

fn report(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_visod"))
        .current_dir(folder)
        .arg("report")
        .args(args)
        .output()
        .unwrap()
}

#[test]
fn a_page_is_written_with_and_without_truth() {
    let folder = tempfile::tempdir().unwrap();
    write_odometry(&folder.path().join("drive <1>.csv"), 40);
    let truth: String = (0..40)
        .map(|i| format!("1 0 0 0.01 0 1 0 0 0 0 1 {i}\n"))
        .collect();
    std::fs::write(folder.path().join("truth.txt"), truth).unwrap();
    for truth in [&[][..], &["--ground-truth", "truth.txt"]] {
        let args = [&["drive <1>.csv", "-o", "page.html"], truth].concat();
        let output = report(folder.path(), &args);
        assert!(
            output.status.success() && output.stdout.is_empty(),
            "{output:?}"
        );
        let page = std::fs::read_to_string(folder.path().join("page.html")).unwrap();
        assert!(page.contains("<h1>Odometry drive &lt;1&gt;</h1>"));
        assert_eq!(page.contains("Error of the pose"), !truth.is_empty());
    }
}

/// Chromium without a window and without a network, or none.
fn chromium(folder: &Path) -> Option<Command> {
    let able = Command::new("chromium").arg("--version").output();
    if !able.is_ok_and(|output| output.status.success()) {
        println!("skipped: there is no chromium");
        return None;
    }
    let mut command = Command::new("chromium");
    command
        .current_dir(folder)
        .arg(format!(
            "--user-data-dir={}",
            folder.join("profile").display()
        ))
        .args([
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--no-first-run",
        ])
        .args([
            "--disable-background-networking",
            "--disable-component-update",
        ])
        .args(["--disable-sync", "--disable-quic", "--hide-scrollbars"])
        .args(["--window-size=1120,3200", "--virtual-time-budget=2000"]);
    Some(command)
}

/// The page in a browser: its script has gone through, zooming zooms, every figure is painted, and on paper
/// it takes more than one sheet.
#[test]
fn a_browser_shows_the_page() {
    let folder = tempfile::tempdir().unwrap();
    let Some(mut browser) = chromium(folder.path()) else {
        return;
    };
    write_odometry(&folder.path().join("drive.csv"), 40);
    let truth: String = (0..40)
        .map(|i| format!("1 0 0 0.01 0 1 0 0 0 0 1 {i}\n"))
        .collect();
    std::fs::write(folder.path().join("truth.txt"), truth).unwrap();
    let args = [
        "drive.csv",
        "--ground-truth",
        "truth.txt",
        "-o",
        "page.html",
    ];
    assert!(report(folder.path(), &args).status.success());
    let page = std::fs::read_to_string(folder.path().join("page.html")).unwrap();
    let figures = page.matches("<figure>").count();
    assert!(figures >= 6, "{figures}");

    // The same page with a hand that presses every figure's first button, which zooms in.
    let hand = "<script>document.querySelectorAll('.tools button:first-child').forEach(b => b.click());\n\
        document.documentElement.dataset.zoomed = document.querySelectorAll('.zoomed').length;</script></body>";
    std::fs::write(
        folder.path().join("pressed.html"),
        page.replace("</body>", hand),
    )
    .unwrap();
    let url = |name: &str| format!("file://{}", folder.path().join(name).display());
    let output = browser
        .args(["--dump-dom", &url("pressed.html")])
        .output()
        .unwrap();
    let dom = String::from_utf8(output.stdout).unwrap();
    for marker in ["figures", "zoomed"] {
        let marker = format!("data-{marker}=\"{figures}\"");
        assert!(
            dom.contains(&marker),
            "no {marker} in {}",
            &dom[..dom.len().min(400)]
        );
    }

    let mut browser = chromium(folder.path()).unwrap();
    let taken = browser
        .args(["--screenshot=page.png", &url("page.html")])
        .output()
        .unwrap();
    assert!(taken.status.success(), "{taken:?}");
    let picture = image::open(folder.path().join("page.png"))
        .unwrap()
        .to_rgb8();
    assert_eq!(picture.dimensions(), (1120, 3200));
    let ground = *picture.get_pixel(2, 2);
    // Each band of 400 px holds something, and the whole more than a few colours.
    for (n, band) in picture.chunks(3 * 1120 * 400).enumerate() {
        let painted = band.chunks(3).filter(|p| *p != ground.0).count();
        assert!(painted > 2000, "band {n}: {painted}");
    }
    let colours: std::collections::HashSet<_> = picture.pixels().map(|p| p.0).collect();
    assert!(colours.len() > 100, "{}", colours.len());

    let mut browser = chromium(folder.path()).unwrap();
    let printed = browser
        .args(["--print-to-pdf=page.pdf", &url("page.html")])
        .output()
        .unwrap();
    assert!(printed.status.success(), "{printed:?}");
    let paper = std::fs::read(folder.path().join("page.pdf")).unwrap();
    let sheets = paper.windows(11).filter(|w| w == b"/Type /Page").count();
    assert!(paper.starts_with(b"%PDF") && sheets > 2, "{sheets}");
}

#[test]
fn what_cannot_be_reported_on_gets_one_clear_sentence() {
    let folder = tempfile::tempdir().unwrap();
    write_odometry(&folder.path().join("empty.csv"), 0);
    write_odometry(&folder.path().join("good.csv"), 5);
    std::fs::write(folder.path().join("plain.txt"), "1 0 0 0 0 1 0 0 0 0 1 0\n").unwrap();
    for (args, code, said) in [
        (
            &["empty.csv", "-o", "x.html"][..],
            1,
            "empty.csv: holds a header but no row",
        ),
        (
            &["plain.txt", "-o", "x.html"],
            1,
            "plain.txt: is a plain trajectory",
        ),
        (&["none.csv", "-o", "x.html"], 1, "none.csv: cannot be read"),
        (
            &["good.csv", "-o", "none/x.html"],
            1,
            "none/x.html: cannot be written",
        ),
        (
            &["good.csv", "-o", "x.html", "--ground-truth", "good.csv"],
            1,
            "good.csv:1: ",
        ),
        (
            &["good.csv", "-o", "x.html", "--max-difference", "nan"],
            2,
            "--max-difference",
        ),
    ] {
        let output = report(folder.path(), args);
        let error = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(code), "{error}");
        assert!(
            error.lines().count() == 1 && error.contains(said),
            "{error}"
        );
        assert!(!folder.path().join("x.html").exists());
    }
}
