//! Messages of ROS 2, as recordings hold them.

use super::sentence;
use visod::ros::camera_info::{Calibration, rig};
use visod::ros::messages::{
    CameraInfo, CompressedImage, DiagnosticArray, Image, Odometry, PointCloud2, TfMessage,
};
use visod::ros::{CdrError, decode, encode};

/// Any bytes are a message or refused; two calibrations that can be read are a rig or refused.
pub fn run(data: &[u8]) {
    refused(decode::<Image>(data).map(drop));
    refused(decode::<CompressedImage>(data).map(drop));
    refused(decode::<TfMessage>(data).map(drop));
    refused(decode::<DiagnosticArray>(data).map(drop));
    refused(decode::<PointCloud2>(data).map(drop));
    refused(decode::<Odometry>(data).map(drop));
    match decode::<CameraInfo>(data) {
        Ok(info) => {
            let mut bytes = Vec::new();
            encode(&info, &mut bytes).expect("what was read can be written");
            let mut other = info.clone();
            other.p.0[3] -= 100.0;
            let of = |info| Calibration {
                topic: "/camera_info",
                info,
                is_rectified: false,
            };
            if let Err(why) = rig(of(&info), of(&other)) {
                sentence::check(&why);
            }
        }
        Err(why) => refused(Err(why)),
    }
}

fn refused(result: Result<(), CdrError>) {
    if let Err(why) = result {
        sentence::check(&why.to_string());
    }
}
