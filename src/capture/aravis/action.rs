//! A time in; the command to every camera of a group to expose at that time out.
//!
//! GigE Vision's scheduled action command: cameras whose clock follows PTP get a broadcast with the time
//! at which to expose, so that neither the network nor this host adds to their skew.

use super::discovery::has;
use crate::capture::camera::{CameraError, monotonic_ns};
use aravis::Camera;
use aravis::prelude::*;
use std::net::{SocketAddr, UdpSocket};
use std::sync::OnceLock;

/// The PTP clock less CLOCK_MONOTONIC, ns. Read once, from whichever camera comes first: what matters
/// is that every camera is told the same time.
static PTP_OFFSET_NS: OnceLock<i64> = OnceLock::new();

/// GigE Vision's control port.
const CONTROL_PORT: u16 = 3956;
/// What the cameras of this daemon listen to: any numbers, the same for both.
const DEVICE_KEY: u32 = 0x5649_534F;
const GROUP_KEY: u32 = 1;
const GROUP_MASK: u32 = 1;
/// How long before its time a command is sent, ns: time for it to arrive.
const AHEAD_NS: i64 = 20_000_000;

/// Commands one camera to expose at given times.
#[derive(Debug)]
pub(super) struct Actions {
    socket: UdpSocket,
    camera: SocketAddr,
    offset_ns: i64,
    next_id: u16,
}

impl Actions {
    /// Makes a camera obey.
    pub(super) fn new(camera: &Camera, address: &str) -> Result<Self, CameraError> {
        let unsuitable = |text: &str| CameraError::Unsuitable(text.to_owned());
        for (feature, value) in [
            ("ActionDeviceKey", i64::from(DEVICE_KEY)),
            ("ActionGroupKey", i64::from(GROUP_KEY)),
            ("ActionGroupMask", i64::from(GROUP_MASK)),
        ] {
            if !has(camera, feature) {
                return Err(unsuitable("has no scheduled actions"));
            }
            camera.set_integer(feature, value).map_err(|e| {
                CameraError::Failed(format!("{feature} cannot be set: {}", e.message()))
            })?;
        }
        let address = address
            .parse()
            .map_err(|_| unsuitable("has no network address to send actions to"))?;
        let failed = |e: std::io::Error| CameraError::Failed(format!("no socket for actions: {e}"));
        let socket = UdpSocket::bind("0.0.0.0:0").map_err(failed)?;
        let read_ns = clock_offset_ns(camera)?;
        Ok(Self {
            socket,
            camera: SocketAddr::new(address, CONTROL_PORT),
            offset_ns: *PTP_OFFSET_NS.get_or_init(|| read_ns),
            next_id: 1,
        })
    }

    /// Has the camera expose a little after `tick_ns` of CLOCK_MONOTONIC, at a time that is the same
    /// for all cameras.
    pub(super) fn schedule(&mut self, tick_ns: i64) -> Result<(), String> {
        let at_ns = tick_ns + AHEAD_NS + self.offset_ns;
        let packet = packet(self.next_id, at_ns as u64);
        self.next_id = self.next_id.checked_add(1).unwrap_or(1);
        let sent = self.socket.send_to(&packet, self.camera);
        sent.map(drop).map_err(|e| e.to_string())
    }
}

/// Reads the camera's clock; half of the time that takes is the uncertainty.
fn clock_offset_ns(camera: &Camera) -> Result<i64, CameraError> {
    let failed = |e: glib::Error| {
        CameraError::Unsuitable(format!("its clock cannot be read: {}", e.message()))
    };
    let (latch, value) = [
        ("TimestampLatch", "TimestampLatchValue"),
        ("GevTimestampControlLatch", "GevTimestampValue"),
    ]
    .into_iter()
    .find(|(latch, _)| has(camera, latch))
    .ok_or_else(|| CameraError::Unsuitable("its clock cannot be read".to_owned()))?;
    let before_ns = monotonic_ns();
    camera.execute_command(latch).map_err(failed)?;
    let after_ns = monotonic_ns();
    let camera_ns = camera.integer(value).map_err(failed)?;
    Ok(camera_ns - (before_ns + after_ns) / 2)
}

/// The command: GigE Vision 2.0, 16.8.1 (ACTION_CMD with its scheduled-time field).
fn packet(id: u16, at_ns: u64) -> [u8; 28] {
    const SCHEDULED_FLAG: u8 = 0x80;
    const ACTION_COMMAND: u16 = 0x0100;
    const PAYLOAD_BYTES: u16 = 20;
    let mut packet = [0; 28];
    packet[0] = 0x42;
    packet[1] = SCHEDULED_FLAG;
    packet[2..4].copy_from_slice(&ACTION_COMMAND.to_be_bytes());
    packet[4..6].copy_from_slice(&PAYLOAD_BYTES.to_be_bytes());
    packet[6..8].copy_from_slice(&id.to_be_bytes());
    packet[8..12].copy_from_slice(&DEVICE_KEY.to_be_bytes());
    packet[12..16].copy_from_slice(&GROUP_KEY.to_be_bytes());
    packet[16..20].copy_from_slice(&GROUP_MASK.to_be_bytes());
    packet[20..28].copy_from_slice(&at_ns.to_be_bytes());
    packet
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_is_laid_out_as_the_standard_has_it() {
        let packet = packet(7, 0x0102_0304_0506_0708);
        assert_eq!(packet[..8], [0x42, 0x80, 0x01, 0x00, 0, 20, 0, 7]);
        assert_eq!(packet[8..20], *b"VISO\0\0\0\x01\0\0\0\x01");
        assert_eq!(packet[20..], [1, 2, 3, 4, 5, 6, 7, 8]);
    }
}
