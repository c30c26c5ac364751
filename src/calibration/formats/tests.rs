//! Round trips, and files as others write them.

use super::*;
use crate::geometry::{Distortion, RigUncertainty, parse_rig};
use nalgebra::{Isometry3, Vector2, Vector3};

fn raw() -> StereoRig {
    parse_rig(
        "left = { width = 640, height = 480, focal = [505.8123456789012, 504.1], principal_point = [313.2, 243.5], distortion = { model = \"radtan\", coefficients = [-0.25, 0.1, 0.0005, -0.0003, 0.01] } }
         right = { width = 640, height = 480, focal = [502.9, 501.2], principal_point = [300.2, 246.4], distortion = { model = \"radtan\", coefficients = [-0.24, 0.09, 0.0001, 0.0002] } }
         right_from_left = { translation_m = [-0.1857, -0.0072, 0.0101], rotation_vector_rad = [0.04046, 0.01616, 0.01419] }",
    )
    .expect("valid")
}

fn rectified() -> StereoRig {
    let mut rig = raw();
    rig.left = crate::geometry::Camera::new(
        640,
        480,
        Vector2::new(718.856, 718.856),
        Vector2::new(607.1928, 185.2157),
        Distortion::None,
    );
    rig.right = rig.left.clone();
    rig.right_from_left = Isometry3::translation(-0.537_165_718_864_418, 0.0, 0.0);
    rig
}

fn fisheye() -> StereoRig {
    let mut rig = raw();
    let lens = |camera: &crate::geometry::Camera, k: [f64; 4]| {
        crate::geometry::Camera::new(
            640,
            480,
            camera.focal_px,
            camera.principal_point_px,
            Distortion::Equidistant(k),
        )
    };
    rig.left = lens(&rig.left, [0.01, -0.02, 0.003, -0.0004]);
    rig.right = lens(&rig.right, [0.02, -0.01, 0.002, -0.0001]);
    rig
}

/// Writes a rig in a format and reads it back, as a user does: the files alone say which format it is.
fn there_and_back(rig: &StereoRig, format: Format) -> StereoRig {
    let folder = tempfile::tempdir().expect("a folder");
    let mut files = Vec::new();
    for file in export(rig, format).expect("can be stated") {
        let name = match (file.name, format) {
            ("", Format::Visod) => "rig.toml",
            ("", Format::Matlab) => "Calib_Results_stereo.m",
            ("", Format::Kitti) => "calib.txt",
            ("", _) => "stereo.yml",
            (name, _) => name,
        };
        let path = folder.path().join(name);
        std::fs::create_dir_all(path.parent().expect("within")).expect("made");
        std::fs::write(&path, file.text).expect("written");
        files.push(path);
    }
    let hints = Hints {
        size_px: (format == Format::Kitti).then_some((640, 480)),
        ..Hints::default()
    };
    import(&files, &hints).expect("reads back")
}

#[test]
fn every_format_reads_back_what_it_can_state() {
    for (rig, formats) in [
        (raw(), &FORMATS[..5]),
        (raw(), &[Format::Matlab][..]),
        (rectified(), &FORMATS[..]),
        (fisheye(), &FORMATS[..5]),
    ] {
        for &format in formats {
            let again = there_and_back(&rig, format);
            assert_eq!(again.left, rig.left, "{format:?}");
            assert_eq!(again.right, rig.right, "{format:?}");
            let apart = again.right_from_left.to_matrix() - rig.right_from_left.to_matrix();
            assert!(apart.amax() < 1e-14, "{format:?}: {apart}");
        }
    }
}

#[test]
fn eight_coefficients_survive_where_the_format_has_them() {
    let mut rig = raw();
    let k = [0.3, 0.05, 0.001, -0.0007, 0.002, 0.6, 0.1, 0.01];
    rig.left = crate::geometry::Camera::new(
        640,
        480,
        rig.left.focal_px,
        rig.left.principal_point_px,
        Distortion::Radtan(k),
    );
    for format in [
        Format::Opencv,
        Format::Ros,
        Format::Kalibr,
        Format::Euroc,
        Format::Visod,
    ] {
        assert_eq!(there_and_back(&rig, format).left, rig.left, "{format:?}");
    }
    assert!(
        export(&rig, Format::Matlab)
            .expect_err("five")
            .contains("takes eight")
    );
}

#[test]
fn what_a_format_cannot_state_is_refused() {
    assert!(
        export(&raw(), Format::Kitti)
            .expect_err("no")
            .contains("rectified cameras alone")
    );
    assert!(
        export(&fisheye(), Format::Matlab)
            .expect_err("no")
            .contains("fisheye")
    );
}

fn file(name: &str, text: &str) -> (tempfile::TempDir, Vec<PathBuf>) {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join(name);
    std::fs::write(&path, text).expect("written");
    (folder, vec![path])
}

#[test]
fn the_toolbox_values_come_with_their_unit_and_uncertainty() {
    let (_folder, files) = file(
        "results.m",
        "% Intrinsic parameters of the left camera\nfc_left = [ 885.81833 ; 884.10614 ];\ncc_left = [ 313.18805 ; 243.49370 ];\n\
         alpha_c_left = [ 0 ];\nkc_left = [ -0.1 ; 0.02 ; 0.001 ; -0.002 ; 0 ];\nfc_right = [882.9 881.2]; cc_right = [ 300.2 ; 246.4 ];\n\
         om = [ 0.04046 0.01616 0.01419 ]; % rotation\nT = [ -385.7 -7.2 0.1 ];\nfc_left_error = [ 1.2 ; 1.5 ]; fc_right_error = [1;1];\n\
         cc_left_error = [3;3]; cc_right_error = [ 2 ; 2 ]; om_error = [ 0.003 0.002 0.001 ]; T_error = [ 0.6 0.3 0.9 ];\n",
    );
    let hints = Hints {
        size_px: Some((640, 480)),
        ..Hints::default()
    };
    let rig = import(&files, &hints).expect("reads");
    assert!(
        (rig.right_from_left.translation.vector - Vector3::new(-0.3857, -0.0072, 0.0001)).norm()
            < 1e-12
    );
    assert_eq!(
        *rig.left.distortion(),
        Distortion::Radtan([-0.1, 0.02, 0.001, -0.002, 0.0, 0.0, 0.0, 0.0])
    );
    assert_eq!(*rig.right.distortion(), Distortion::None);
    let Some(RigUncertainty::Sigmas {
        focal_px,
        translation_m,
        ..
    }) = rig.uncertainty
    else {
        panic!("stated")
    };
    assert!((focal_px - 0.5).abs() < 1e-12 && (translation_m - 3e-4).abs() < 1e-12);
    let unsized_rig = import(&files, &Hints::default()).expect_err("no size");
    assert!(unsized_rig.contains("--size"), "{unsized_rig}");
}

#[test]
fn mistakes_are_named_with_file_line_and_key() {
    let yaml = export(&raw(), Format::Opencv)
        .expect("stated")
        .remove(0)
        .text;
    let error = |text: &str| {
        let (_folder, files) = file("stereo.yml", text);
        import(&files, &Hints::default()).expect_err("wrong")
    };
    assert!(error(&yaml.replace("\nR:", "\nQ:")).contains("holds no R"));
    let tilted = error(&yaml.replace("rows: 1\n   cols: 5\n   dt: d\n   data: [ -0.25", "rows: 1\n   cols: 14\n   dt: d\n   data: [ 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.3, -0.25"));
    assert!(
        tilted.contains("D1") && tilted.contains("thin prism"),
        "{tilted}"
    );
    let turned = error(&yaml.replace(
        "\nR: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 0.9",
        "\nR: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 1.9",
    ));
    assert!(turned.contains("R: is not a rotation matrix"), "{turned}");
    let unknown = error("hello: 1\n");
    assert!(unknown.contains("no format that is known"), "{unknown}");
    let (_folder, files) = file(
        "camchain.yaml",
        "cam0:\n  camera_model: omni\ncam1:\n  T_cn_cnm1: [[1,0,0,-0.1],[0,1,0,0],[0,0,1,0],[0,0,0,1]]\n",
    );
    let omni = import(&files, &Hints::default()).expect_err("omni");
    assert!(
        omni.contains("camera_model") && omni.contains("omni"),
        "{omni}"
    );
    let one = import(
        &[files[0].clone()],
        &Hints {
            format: Some(Format::Ros),
            ..Hints::default()
        },
    )
    .expect_err("two");
    assert!(
        one.contains("2 files, left and right, but 1 were named"),
        "{one}"
    );
}
