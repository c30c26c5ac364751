use super::*;
use crate::geometry::{Distortion, check_rig, parse_rig};
use nalgebra::Vector3;
use std::fs;
use tempfile::TempDir;

const RIG: &str = r#"
[left]
width = 8
height = 6
focal = [8.0, 8.0]
principal_point = [3.5, 2.5]

[right]
width = 8
height = 6
focal = [8.0, 8.0]
principal_point = [3.5, 2.5]

[right_from_left]
translation_m = [-0.1, 0.0, 0.0]
rotation_vector_rad = [0.0, 0.0, 0.0]
"#;

const CALIB: &str = "P0: 8 0 3.5 0 0 8 2.5 0 0 0 1 0\nP1: 8 0 3.5 -4 0 8 2.5 0 0 0 1 0\n";

const SENSOR: &str = "%YAML:1.0
# General sensor definitions.
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, 0.25,
         0.0, 1.0, 0.0, 0.0,
         0.0, 0.0, 1.0, 0.0,
         0.0, 0.0, 0.0, 1.0]
resolution: [8, 6]
camera_model: pinhole
intrinsics: [8.0, 8.0, 3.5, 2.5] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 1.76e-05]
";

/// A folder with files; a path that ends in an image's ending gets a PGM of 8×6 px.
fn folder(files: &[(&str, &str)]) -> TempDir {
    let dir = tempfile::tempdir().expect("a folder");
    for (name, text) in files {
        put(&dir, name, text);
    }
    dir
}

fn put(dir: &TempDir, name: &str, text: &str) {
    let file = dir.path().join(name);
    fs::create_dir_all(file.parent().expect("a parent")).expect("made");
    let image = format!("P5 8 6 255\n{}", "x".repeat(48));
    let text = if name.ends_with(".pgm") { &image } else { text };
    fs::write(file, text).expect("written");
}

fn own() -> TempDir {
    let dir = folder(&[("rig.toml", RIG)]);
    for name in ["000000", "000001", "000002"] {
        put(&dir, &format!("left/{name}.pgm"), "");
        put(&dir, &format!("right/{name}.pgm"), "");
    }
    dir
}

fn kitti() -> TempDir {
    let dir = folder(&[
        ("calib.txt", CALIB),
        ("times.txt", "0\n1.000000e-01\n0.2\n"),
    ]);
    for name in ["000000", "000001", "000002"] {
        put(&dir, &format!("image_0/{name}.pgm"), "");
        put(&dir, &format!("image_1/{name}.pgm"), "");
    }
    dir
}

fn euroc() -> TempDir {
    let right = SENSOR.replace("0.0, 0.25", "0.0, 0.36");
    let dir = folder(&[
        ("mav0/cam0/sensor.yaml", SENSOR),
        ("mav0/cam1/sensor.yaml", &right),
    ]);
    for stamp in ["1000", "50001000", "100001000"] {
        put(&dir, &format!("mav0/cam0/data/{stamp}.pgm"), "");
        put(&dir, &format!("mav0/cam1/data/{stamp}.pgm"), "");
    }
    dir
}

/// What opening says, without the folder's own path.
fn refusal(dir: &TempDir) -> String {
    let error = Dataset::open(dir.path(), None).expect_err("must be refused");
    let text = error.to_string();
    assert!(!text.contains('\n'), "{text}");
    text.replace(&format!("{}/", dir.path().display()), "")
        .replace(&dir.path().display().to_string(), "DIR")
}

fn opened(dir: &TempDir) -> Dataset {
    Dataset::open(dir.path(), None).expect("a recording")
}

fn stamps(dataset: &Dataset) -> Vec<i64> {
    dataset.pairs.iter().map(|pair| pair.timestamp_ns).collect()
}

/// The reasons of the pairs that miss an image, with their numbers.
fn unpaired(dir: &TempDir, dataset: &Dataset) -> Vec<(usize, String)> {
    let here = format!("{}/", dir.path().display());
    let why = |images: &ImageFiles| match images {
        ImageFiles::Both { .. } => None,
        ImageFiles::Unpaired { why } => Some(why.replace(&here, "")),
    };
    let pairs = dataset.pairs.iter().enumerate();
    pairs
        .filter_map(|(n, p)| Some((n, why(&p.images)?)))
        .collect()
}

#[test]
fn each_layout_is_recognised_by_what_the_folder_holds() {
    let dir = own();
    let dataset = opened(&dir);
    assert_eq!(dataset.layout, Layout::Visod);
    assert_eq!(dataset.rig, parse_rig(RIG).expect("valid"));
    assert!(dataset.nominal_times);
    assert_eq!(stamps(&dataset), [0, 100_000_000, 200_000_000]);
    assert_eq!(dataset.ground_truth, None);

    let dir = kitti();
    put(&dir, "poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0");
    let dataset = opened(&dir);
    assert_eq!(dataset.layout, Layout::Kitti);
    assert!(!dataset.nominal_times);
    assert_eq!(stamps(&dataset), [0, 100_000_000, 200_000_000]);
    assert_eq!(dataset.ground_truth, Some(dir.path().join("poses.txt")));
    assert_eq!(dataset.rig.left.width, 8);
    let right_in_left = dataset.rig.right_from_left.translation.vector;
    assert_eq!(right_in_left, Vector3::new(-0.5, 0.0, 0.0));

    let dir = euroc();
    for path in [dir.path().to_owned(), dir.path().join("mav0")] {
        let dataset = Dataset::open(&path, None).expect("a recording");
        assert_eq!(dataset.layout, Layout::Euroc);
        assert_eq!(stamps(&dataset), [1000, 50_001_000, 100_001_000]);
        let translation = dataset.rig.right_from_left.translation.vector;
        assert!((translation - Vector3::new(-0.11, 0.0, 0.0)).norm() < 1e-15);
    }
}

#[test]
fn another_rig_takes_the_place_of_the_recordings_own() {
    let rig = parse_rig(RIG).expect("valid");
    let dir = own();
    fs::remove_file(dir.path().join("rig.toml")).expect("removed");
    assert!(refusal(&dir).ends_with("neither rig.toml nor calib.txt: name a rig file with --rig"));
    let dataset = Dataset::open(dir.path(), Some(rig.clone())).expect("a recording");
    assert_eq!((dataset.layout, &dataset.rig), (Layout::Visod, &rig));
    // Broken calibrations are not read then.
    let dir = kitti();
    put(&dir, "calib.txt", "garbage");
    assert_eq!(
        Dataset::open(dir.path(), Some(rig.clone()))
            .expect("open")
            .rig,
        rig
    );
    let dir = euroc();
    put(&dir, "mav0/cam0/sensor.yaml", "garbage");
    assert_eq!(
        Dataset::open(dir.path(), Some(rig.clone()))
            .expect("open")
            .rig,
        rig
    );
}

#[test]
fn a_folder_that_is_no_recording_says_why() {
    assert_eq!(refusal(&folder(&[])), "DIR: the folder is empty");
    let other = refusal(&folder(&[("notes.md", "")]));
    assert!(
        other.starts_with("DIR: holds no recording: there is neither left/"),
        "{other}"
    );
    let half = folder(&[("rig.toml", RIG), ("left/0.pgm", "")]);
    assert_eq!(
        refusal(&half),
        "right: is missing, while the other camera's folder is there"
    );
    let dir = own();
    let file = dir.path().join("rig.toml");
    let error = Dataset::open(&file, None).expect_err("a file");
    assert!(
        error
            .to_string()
            .ends_with("rig.toml: is not a folder with a recording")
    );
    let error = Dataset::open(&dir.path().join("absent"), None).expect_err("absent");
    assert!(
        error
            .to_string()
            .contains("absent: cannot be read: No such file")
    );
}

#[test]
fn folders_without_images_or_common_names_are_refused() {
    let dir = own();
    for entry in fs::read_dir(dir.path().join("right")).expect("there") {
        fs::remove_file(entry.expect("entry").path()).expect("removed");
    }
    assert_eq!(refusal(&dir), "right: holds no PNG, JPEG, PGM or PPM image");
    put(&dir, "right/other.pgm", "");
    assert_eq!(
        refusal(&dir),
        "right: has no image of the same name as one in left"
    );
    let dir = own();
    put(&dir, "left/000001.png", "");
    assert_eq!(
        refusal(&dir),
        "left/000001.png: has the same name as left/000001.pgm"
    );
    let dir = own();
    put(&dir, "left/000001\x1B[2J.pgm", "");
    assert_eq!(
        refusal(&dir),
        "left: holds an image whose name has a control character: \"000001\u{FFFD}[2J\""
    );
}

#[test]
fn a_missing_image_costs_its_pair_and_no_other() {
    let dir = own();
    fs::remove_file(dir.path().join("right/000001.pgm")).expect("removed");
    put(&dir, "left/000003.pgm", "");
    put(&dir, "right/000004.pgm", "");
    put(&dir, "times.txt", "0\n1\n2\n3\n4\n");
    put(&dir, "left/._000001.pgm", "");
    put(&dir, "left/Thumbs.db", "");
    let dataset = opened(&dir);
    let why = |n: usize, gone: &str, there: &str| {
        (n, format!("{gone}: is missing, while {there} is there"))
    };
    assert_eq!(
        unpaired(&dir, &dataset),
        [
            why(1, "right/000001.pgm", "left/000001.pgm"),
            why(3, "right/000003.pgm", "left/000003.pgm"),
            why(4, "left/000004.pgm", "right/000004.pgm"),
        ]
    );
    assert_eq!(dataset.pairs.len(), 5);
}

#[test]
fn numbered_names_are_sorted_as_numbers() {
    let dir = folder(&[("rig.toml", RIG)]);
    for name in ["10", "9", "1"] {
        put(&dir, &format!("left/{name}.pgm"), "");
        put(&dir, &format!("right/{name}.pgm"), "");
    }
    let names: Vec<_> = opened(&dir)
        .pairs
        .iter()
        .map(|pair| match &pair.images {
            ImageFiles::Both { left, .. } => left.file_name().expect("a name").to_owned(),
            ImageFiles::Unpaired { why } => panic!("{why}"),
        })
        .collect();
    assert_eq!(names, ["1.pgm", "9.pgm", "10.pgm"]);
}

#[test]
fn times_that_do_not_fit_are_refused_with_their_line() {
    let with_times = |times: &str| {
        let dir = own();
        put(&dir, "times.txt", times);
        dir
    };
    assert_eq!(
        refusal(&with_times("0\n0.1\n")),
        "times.txt: has 2 times, but there are 3 image pairs in left and right"
    );
    assert_eq!(
        refusal(&with_times("0\n0.1\nsoon\n")),
        "times.txt:3: a time in seconds was expected, but it reads \"soon\""
    );
    assert!(refusal(&with_times("0\nnan\n2\n")).starts_with("times.txt:2: a time"));
    assert_eq!(
        refusal(&with_times("0\n# a comment\n0.2\n0.1\n")),
        "times.txt:4: the time 0.1 does not lie after the one before"
    );
    let dir = own();
    fs::write(dir.path().join("times.txt"), b"0\n0.1\n\xff\n").expect("written");
    assert_eq!(refusal(&dir), "times.txt:3: is not UTF-8 text");
}

#[test]
fn the_times_of_a_whole_recording_serve_a_part_of_it_by_number() {
    let dir = folder(&[("rig.toml", RIG), ("times.txt", "0\n1\n2\n3\n4\n5\n6\n")]);
    for name in ["002", "003", "005"] {
        put(&dir, &format!("left/{name}.pgm"), "");
        put(&dir, &format!("right/{name}.pgm"), "");
    }
    let dataset = opened(&dir);
    assert_eq!(stamps(&dataset), [2, 3, 4, 5].map(|s| s * 1_000_000_000));
    let gone = (2, "left: neither camera has an image number 4".to_owned());
    assert_eq!(unpaired(&dir, &dataset), [gone]);

    // Names that are no numbers have no place in longer times.
    put(&dir, "left/last.pgm", "");
    put(&dir, "right/last.pgm", "");
    assert!(refusal(&dir).starts_with("times.txt: has 7 times, but there are 4 image pairs"));
}

#[test]
fn a_broken_rig_file_is_named_with_line_and_key() {
    let dir = own();
    put(
        &dir,
        "rig.toml",
        &RIG.replacen("focal = [8.0,", "focal = [nan,", 1),
    );
    assert_eq!(
        refusal(&dir),
        "rig.toml:5: left.focal: must be finite and above 0 px, but holds NaN"
    );
}

#[test]
fn a_broken_kitti_calibration_is_named_with_line_and_key() {
    for (from, to, expected) in [
        (
            "P1:",
            "P7:",
            "calib.txt: P1: the projection matrix is missing",
        ),
        (
            " -4 ",
            " ",
            "calib.txt:2: P1: a projection matrix has 12 numbers, but there are 11",
        ),
        (
            " -4 ",
            " nan ",
            "calib.txt:2: P1: a finite number was expected, but it reads \"nan\"",
        ),
        (
            " -4 ",
            " four ",
            "calib.txt:2: P1: a finite number was expected, but it reads \"four\"",
        ),
        (
            " -4 ",
            " 0 ",
            "calib.txt:2: P1: the cameras must stand apart, but the baseline is zero",
        ),
        (
            "P0: 8",
            "P0: -8",
            "calib.txt:1: P0: focal lengths must be above 0 px, but are -8 and 8",
        ),
        (
            "P0: 8 0",
            "P0: 8 1",
            "calib.txt:1: P0: is not the matrix of a rectified camera, [f 0 c ·; 0 f c ·; 0 0 1 ·]",
        ),
    ] {
        let dir = kitti();
        assert!(
            CALIB.contains(from),
            "the test's own replacement must apply"
        );
        put(&dir, "calib.txt", &CALIB.replacen(from, to, 1));
        assert_eq!(refusal(&dir), expected);
    }
}

#[test]
fn kitti_takes_the_images_size_from_the_first_pair_that_can_be_read() {
    let dir = kitti();
    fs::write(dir.path().join("image_0/000000.pgm"), "").expect("written");
    let dataset = opened(&dir);
    assert_eq!((dataset.rig.left.width, dataset.rig.right.height), (8, 6));
    for name in ["000001", "000002"] {
        fs::write(dir.path().join(format!("image_1/{name}.pgm")), "no image").expect("written");
    }
    assert_eq!(
        refusal(&dir),
        "image_0: no pair of images can be read: image_0/000000.pgm: the file is empty"
    );
}

#[test]
fn the_benchmarks_own_place_of_the_truth_is_found() {
    let dir = folder(&[("poses/07.txt", "")]);
    let sequence = dir.path().join("sequences/07");
    let inner = kitti();
    fs::create_dir_all(dir.path().join("sequences")).expect("made");
    fs::rename(inner.path(), &sequence).expect("moved");
    let dataset = Dataset::open(&sequence, None).expect("a recording");
    assert!(dataset.ground_truth.is_some_and(|file| file.is_file()));
}

#[test]
fn a_broken_sensor_file_is_named_with_line_and_key() {
    let file = "mav0/cam0/sensor.yaml";
    for (from, to, expected) in [
        (
            "resolution: [8, 6]\n",
            "",
            ": resolution: the key is missing",
        ),
        (
            "resolution: [8, 6]",
            "resolution: [8, 6.5]",
            ":11: resolution: sides must be whole numbers from 1 to 16384 px, but hold 6.5",
        ),
        (
            "[8.0, 8.0, 3.5, 2.5]",
            "[8.0, 8.0, 3.5]",
            ":13: intrinsics: has 4 numbers, but there are 3",
        ),
        (
            "[8.0, 8.0, 3.5, 2.5]",
            "[8.0, .nan, 3.5, 2.5]",
            ":13: intrinsics: a finite number was expected, but it reads \".nan\"",
        ),
        (
            "pinhole",
            "omni",
            ":12: camera_model: only \"pinhole\" is read, but it is \"omni\"",
        ),
        (
            "radial-tangential",
            "fov",
            ":14: distortion_model: \"radial-tangential\", \"equidistant\" and \"none\" are read, but it is \"fov\"",
        ),
        (
            "[-0.28, 0.07,",
            "[-0.28,",
            ":15: distortion_coefficients: \"radial-tangential\" takes 4, 5 or 8 coefficients, but there are 3",
        ),
        (
            "0.0, 0.0, 0.0, 1.0]",
            "0.0, 0.0, 1.0]",
            ":7: T_BS: a 4×4 matrix has 16 numbers, but there are 15",
        ),
        (
            "data: [1.0,",
            "data: [2.0,",
            ":7: T_BS: is not a rigid motion, [R t; 0 0 0 1]",
        ),
    ] {
        let dir = euroc();
        assert!(
            SENSOR.contains(from),
            "the test's own replacement must apply"
        );
        put(&dir, file, &SENSOR.replacen(from, to, 1));
        assert_eq!(refusal(&dir), format!("{file}{expected}"));
    }
    let dir = euroc();
    put(
        &dir,
        file,
        &SENSOR.replace("intrinsics: [8.0", "intrinsics: {8.0"),
    );
    assert!(refusal(&dir).starts_with(&format!("{file}:")));
    put(&dir, file, SENSOR);
    put(&dir, "mav0/cam1/sensor.yaml", SENSOR);
    assert_eq!(
        refusal(&dir),
        "mav0/cam1/sensor.yaml: T_BS: the cameras must stand apart, but the baseline is zero"
    );
    fs::remove_file(dir.path().join("mav0/cam1/sensor.yaml")).expect("removed");
    assert!(refusal(&dir).starts_with("mav0/cam1/sensor.yaml: cannot be read: No such file"));
}

#[test]
fn an_equidistant_lens_is_read() {
    let dir = euroc();
    let fisheye = SENSOR.replace("radial-tangential", "equidistant");
    put(&dir, "mav0/cam0/sensor.yaml", &fisheye);
    let rig = opened(&dir).rig;
    let k = [-0.28, 0.07, 0.0002, 1.76e-05];
    assert_eq!(*rig.left.distortion(), Distortion::Equidistant(k));
    let [a, b, c, d] = k;
    let k = [a, b, c, d, 0.0, 0.0, 0.0, 0.0];
    assert_eq!(*rig.right.distortion(), Distortion::Radtan(k));
}

#[test]
fn a_dropped_frame_of_euroc_costs_its_pair_and_no_other() {
    let dir = euroc();
    fs::remove_file(dir.path().join("mav0/cam1/data/50001000.pgm")).expect("removed");
    // Stamps that differ by less than the tolerance are the same instant.
    put(&dir, "mav0/cam0/data/150000000.pgm", "");
    put(&dir, "mav0/cam1/data/151900000.pgm", "");
    put(&dir, "mav0/cam1/data/199000000.pgm", "");
    let dataset = opened(&dir);
    assert_eq!(
        unpaired(&dir, &dataset),
        [
            (
                1,
                "mav0/cam0/data/50001000.pgm: has no right image within 2 ms".to_owned()
            ),
            (
                4,
                "mav0/cam1/data/199000000.pgm: has no left image within 2 ms".to_owned()
            ),
        ]
    );
    assert_eq!(
        stamps(&dataset),
        [1000, 50_001_000, 100_001_000, 150_000_000, 199_000_000]
    );
}

#[test]
fn the_list_of_euroc_goes_before_the_names() {
    let dir = euroc();
    let csv = "mav0/cam0/data.csv";
    put(
        &dir,
        csv,
        "#timestamp [ns],filename\r\n1500,1000.pgm\r\n50001500,50001000.pgm\r\n",
    );
    let dataset = opened(&dir);
    assert_eq!(stamps(&dataset), [1500, 50_001_500, 100_001_000]);
    for (rows, expected) in [
        ("#only a head\n", ": lists no image"),
        (
            "1000\n",
            ":1: a stamp in ns, a comma and a file name were expected",
        ),
        (
            "soon,1.pgm\n",
            ":1: a stamp in ns was expected, but it reads \"soon\"",
        ),
        (
            "1,1.pgm\n1,2.pgm\n",
            ":2: the stamp 1 does not lie after the one before",
        ),
        (
            "1,../../secret.pgm\n",
            ":1: the name of a file in data/ was expected, but it reads \"../../secret.pgm\"",
        ),
        (
            "1,/etc/passwd\n",
            ":1: the name of a file in data/ was expected, but it reads \"/etc/passwd\"",
        ),
        (
            "1,..\n",
            ":1: the name of a file in data/ was expected, but it reads \"..\"",
        ),
        (
            "1,\n",
            ":1: the name of a file in data/ was expected, but it reads \"\"",
        ),
    ] {
        put(&dir, csv, rows);
        assert_eq!(refusal(&dir), format!("{csv}{expected}"));
    }
    let dir = euroc();
    put(&dir, "mav0/cam0/data/first.pgm", "");
    assert_eq!(
        refusal(&dir),
        "mav0/cam0/data/first.pgm: without data.csv the name must be the stamp in ns"
    );
}

#[cfg(unix)]
#[test]
fn names_that_are_not_text_are_paired_like_others() {
    use std::os::unix::ffi::OsStrExt;
    let dir = own();
    let name = std::ffi::OsStr::from_bytes(b"\xff\xfe.pgm");
    for side in ["left", "right"] {
        if fs::write(dir.path().join(side).join(name), "").is_err() {
            eprintln!("skipped: this file system takes no such name");
            return;
        }
    }
    assert_eq!(opened(&dir).pairs.len(), 4);
    fs::remove_file(dir.path().join("right").join(name)).expect("removed");
    assert_eq!(unpaired(&dir, &opened(&dir)).len(), 1);
    let dir = euroc();
    fs::write(dir.path().join("mav0/cam0/data").join(name), "").expect("written");
    assert!(refusal(&dir).ends_with("without data.csv the name must be the stamp in ns"));
}

#[test]
fn settings_out_of_range_are_refused() {
    assert_eq!(Settings::default().check(), Ok(()));
    let refused = |settings: Settings| settings.check().expect_err("out of range").key;
    let read_ahead = Settings {
        read_ahead: 0,
        ..Settings::default()
    };
    assert_eq!(refused(read_ahead), "read_ahead");
    let tolerance = Settings {
        pairing_tolerance_s: f64::NAN,
        ..Settings::default()
    };
    assert_eq!(refused(tolerance), "pairing_tolerance_s");
    let white = Settings {
        white_level: 0,
        ..Settings::default()
    };
    assert_eq!(refused(white), "white_level");
}

/// A test recording, where it is there.
fn recording(name: &str) -> Option<PathBuf> {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let data = std::env::var_os("VISOD_TEST_DATA").map_or(beside, PathBuf::from);
    let path = Some(data.join(name)).filter(|path| path.is_dir());
    if path.is_none() {
        println!("skipped: the test recording {name} is not there");
    }
    path
}

#[test]
fn the_rig_of_a_kitti_recording_is_the_published_one() {
    let Some(path) = recording("kitti_straight") else {
        return;
    };
    let dataset = Dataset::open(&path, None).expect("a recording");
    assert_eq!((dataset.layout, dataset.pairs.len()), (Layout::Kitti, 51));
    let left = &dataset.rig.left;
    assert_eq!((left.width, left.height), (1226, 370));
    assert_eq!(left.focal_px.x, 707.0912);
    // The benchmark's own figure: 379.8145 px·m over 707.0912 px.
    assert!((dataset.rig.baseline_m() - 0.537_150_65).abs() < 1e-7);
    assert!(dataset.rig.right_from_left.translation.x < 0.0);
    assert_eq!(check_rig(&dataset.rig), []);
    assert_eq!(dataset.pairs[50].timestamp_ns, 5_000_000_000);
}

#[test]
fn the_rig_of_a_euroc_recording_is_the_published_one() {
    let Some(path) = recording("euroc_standstill") else {
        return;
    };
    let dataset = Dataset::open(&path, None).expect("a recording");
    assert_eq!((dataset.layout, dataset.pairs.len()), (Layout::Euroc, 40));
    assert_eq!(
        unpaired(&tempfile::tempdir().expect("a folder"), &dataset),
        []
    );
    // The data set's paper states a baseline of 11 cm.
    assert!((dataset.rig.baseline_m() - 0.110).abs() < 5e-4);
    assert!(dataset.rig.right_from_left.translation.x < -0.109);
    assert_eq!(check_rig(&dataset.rig), []);
    assert_eq!(dataset.pairs[0].timestamp_ns, 1_403_715_273_262_142_976);
    assert!(dataset.ground_truth.is_some());
}
