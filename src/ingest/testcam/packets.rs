//! Faults of a test camera's RTP packets, whatever they travel by.

use std::sync::{Arc, Mutex, MutexGuard};

use gstreamer as gst;
use gstreamer::prelude::*;

use super::fault::Fault;

/// The packets of all clients.
#[derive(Default)]
pub(super) struct Packets(Mutex<State>);

#[derive(Default)]
struct State {
    fault: Option<Fault>,
    /// Added to every time stamp, of 90 kHz.
    shift: u32,
    /// Counts the [`Fault::RestartClock`]s.
    restarts: u32,
}

/// What is known of one client's packets.
#[derive(Default)]
struct Sent {
    restarts: u32,
    /// Taken off the time stamps and sequence numbers.
    origin: (u32, u16),
    random: fastrand::Rng,
}

/// An hour of RTP's time for video.
const HOUR: u32 = 3_600 * 90_000;
/// One packet of so many is lost.
const LOSS: u32 = 10;
/// The fixed part of an RTP header (RFC 3550, section 5.1).
const HEADER: usize = 12;

impl Packets {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }

    pub fn set(&self, fault: Option<Fault>) {
        let mut state = self.lock();
        match fault {
            Some(Fault::JumpForward) => state.shift = state.shift.wrapping_add(HOUR),
            Some(Fault::JumpBackward) => state.shift = state.shift.wrapping_sub(HOUR),
            Some(Fault::RestartClock) => state.restarts += 1,
            _ => {}
        }
        state.fault = fault;
    }

    /// Watches what leaves a payloader.
    pub fn watch(self: &Arc<Self>, pad: &gst::Pad) {
        let all = self.clone();
        let restarts = all.lock().restarts;
        let sent = Mutex::new(Sent { restarts, random: fastrand::Rng::with_seed(3), ..Sent::default() });
        pad.add_probe(gst::PadProbeType::BUFFER | gst::PadProbeType::BUFFER_LIST, move |_, info| {
            let mut sent = sent.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
            let state = all.lock();
            let sends = match &mut info.data {
                Some(gst::PadProbeData::Buffer(buffer)) => state.pass(&mut sent, buffer),
                Some(gst::PadProbeData::BufferList(list)) => {
                    let mut kept = gst::BufferList::new();
                    if let Some(kept) = kept.get_mut() {
                        for mut buffer in list.iter_owned() {
                            if state.pass(&mut sent, &mut buffer) {
                                kept.add(buffer);
                            }
                        }
                    }
                    *list = kept;
                    !list.is_empty()
                }
                _ => true,
            };
            if sends { gst::PadProbeReturn::Ok } else { gst::PadProbeReturn::Drop }
        });
    }
}

impl State {
    /// Does to a packet what is to be done; whether it is sent at all.
    fn pass(&self, sent: &mut Sent, packet: &mut gst::Buffer) -> bool {
        if self.fault == Some(Fault::Loss) && sent.random.u32(..LOSS) == 0 {
            return false;
        }
        let restarted = sent.restarts != self.restarts;
        if !restarted && self.shift == 0 && sent.origin == (0, 0) && self.fault != Some(Fault::Noise) {
            return true;
        }
        let Ok(mut bytes) = packet.make_mut().map_writable() else { return true };
        let Some((header, payload)) = bytes.split_at_mut_checked(HEADER) else { return true };
        let number = u16::from_be_bytes([header[2], header[3]]);
        let time = u32::from_be_bytes([header[4], header[5], header[6], header[7]]);
        let time = time.wrapping_add(self.shift);
        if restarted {
            sent.restarts = self.restarts;
            sent.origin = (time, number);
        }
        header[2..4].copy_from_slice(&number.wrapping_sub(sent.origin.1).to_be_bytes());
        header[4..8].copy_from_slice(&time.wrapping_sub(sent.origin.0).to_be_bytes());
        if self.fault == Some(Fault::Noise) {
            sent.random.fill(payload);
        }
        true
    }
}
