//! Tracked features in, a cloud of points out, with what is known of each.

use super::convert::{OPTICAL, header};
use crate::estimation::TrackedFeature;
use crate::ros::Bytes;
use crate::ros::messages::{PointCloud2, PointField};

/// `sensor_msgs/PointField`'s numbers of types.
const UINT32: u8 = 6;
const FLOAT32: u8 = 7;

/// What each point holds, four bytes each: its place in the left camera, m; pairs before this one that
/// showed it, by which viewers may colour it; its name, the lower 32 bits; where both images show it, px;
/// its covariance, m².
#[rustfmt::skip]
const FIELDS: [(&str, u8); 15] = [
    ("x", FLOAT32), ("y", FLOAT32), ("z", FLOAT32),
    ("age", UINT32), ("id", UINT32),
    ("left_u", FLOAT32), ("left_v", FLOAT32), ("right_u", FLOAT32), ("right_v", FLOAT32),
    ("cov_xx", FLOAT32), ("cov_xy", FLOAT32), ("cov_xz", FLOAT32),
    ("cov_yy", FLOAT32), ("cov_yz", FLOAT32), ("cov_zz", FLOAT32),
];

/// The cloud of one pair.
pub(super) fn cloud(timestamp_ns: i64, features: &[TrackedFeature]) -> PointCloud2 {
    let step = 4 * FIELDS.len() as u32;
    let width = features.len() as u32;
    let mut data = Vec::with_capacity(features.len() * step as usize);
    for feature in features {
        push_point(&mut data, feature);
    }
    let field = |(i, (name, datatype)): (u32, (&str, u8))| PointField {
        name: name.to_owned(),
        offset: 4 * i,
        datatype,
        count: 1,
    };
    PointCloud2 {
        header: header(OPTICAL[0], timestamp_ns),
        height: 1,
        width,
        fields: (0..).zip(FIELDS).map(field).collect(),
        is_bigendian: false,
        point_step: step,
        row_step: step * width,
        data: Bytes(data),
        is_dense: true,
    }
}

fn push_point(data: &mut Vec<u8>, feature: &TrackedFeature) {
    let c = &feature.landmark.cov_m2;
    push_floats(data, feature.landmark.point.coords.as_slice());
    data.extend_from_slice(&feature.age.to_le_bytes());
    data.extend_from_slice(&(feature.id as u32).to_le_bytes());
    push_floats(data, feature.measurement.px.as_slice());
    let upper_triangle = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)];
    push_floats(data, &upper_triangle.map(|at| c[at]));
}

fn push_floats(data: &mut Vec<u8>, values: &[f64]) {
    for value in values {
        data.extend_from_slice(&(*value as f32).to_le_bytes());
    }
}
