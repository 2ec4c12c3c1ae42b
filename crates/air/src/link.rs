//! Links between two controllers: connection events, flow control, encryption, supervision.

use std::collections::VecDeque;
use std::time::Duration;

use crate::hci::{self, Address, LinkTiming, status};
use crate::medium::{DeviceId, Event, Medium, now_micros};

/// Microseconds of a connection interval unit.
const INTERVAL_UNIT: u64 = 1250;
/// Microseconds of a supervision timeout unit.
const TIMEOUT_UNIT: u64 = 10_000;
/// Shortest time between two packets on the air.
const FRAME_SPACE: u64 = 150;
/// Bytes of preamble, access address, header, MIC and CRC around the payload.
const OVERHEAD: u64 = 14;

/// A data fragment on its way.
#[derive(Debug, Clone, Copy)]
pub struct Fragment<'a> {
    /// Who sends it.
    pub from: DeviceId,
    /// Who is to receive it.
    pub to: DeviceId,
    /// It begins an L2CAP frame, else it continues one.
    pub first: bool,
    /// The L2CAP bytes.
    pub data: &'a [u8],
}

/// What becomes of a fragment.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Fate {
    /// It arrives.
    Deliver,
    /// Other bytes arrive.
    Replace(Vec<u8>),
    /// It arrives later, and so does everything behind it.
    Delay(Duration),
    /// It never arrives. A radio repeats until it gets through; this models a broken controller.
    Lose,
    /// The link breaks at this point with an HCI reason (0x08: supervision timeout).
    Kill(u8),
}

pub(crate) struct Packet {
    first: bool,
    data: Vec<u8>,
    delayed: bool,
}

/// One side of a link: 0 central, 1 peripheral.
pub(crate) struct End {
    pub device: usize,
    pub handle: u16,
    queue: VecDeque<Packet>,
    /// Nothing goes out before (us).
    hold: u64,
}

pub(crate) struct Link {
    pub ends: [End; 2],
    pub timing: LinkTiming,
    /// Time of one connection event (us); the others are whole intervals away.
    anchor: u64,
    last_heard: u64,
    exchange_planned: bool,
    encrypted: bool,
    /// Key of the central while the peripheral is asked for its own.
    offered_key: Option<[u8; 16]>,
}

impl Link {
    fn interval(&self) -> u64 {
        u64::from(self.timing.interval.max(1)) * INTERVAL_UNIT
    }

    fn timeout(&self) -> u64 {
        u64::from(self.timing.timeout.max(1)) * TIMEOUT_UNIT
    }

    /// The first connection event after `time`.
    fn event_after(&self, time: u64) -> u64 {
        let passed = time.saturating_sub(self.anchor) / self.interval();
        self.anchor + (passed + 1) * self.interval()
    }
}

impl Medium {
    /// Links a central with a peripheral; both hosts are told.
    pub fn connect(&mut self, devices: [usize; 2], addresses: [Address; 2], timing: LinkTiming) {
        let id = self.new_link_id();
        let [central, peripheral] = devices;
        let ends = devices.map(|device| End {
            device,
            handle: self.devices[device].new_handle(id),
            queue: VecDeque::new(),
            hold: 0,
        });
        let now = now_micros();
        for (side, (device, peer)) in
            [(central, addresses[1]), (peripheral, addresses[0])].into_iter().enumerate()
        {
            let event = hci::connected(ends[side].handle, side == 1, peer, timing);
            self.devices[device].send(event);
        }
        let link = Link {
            ends,
            timing,
            anchor: now,
            last_heard: now,
            exchange_planned: false,
            encrypted: false,
            offered_key: None,
        };
        let timeout = link.timeout();
        self.links.insert(id, link);
        self.after(timeout / 4, Event::Supervise { link: id });
    }

    /// A host hands down data for one of its links.
    pub fn send_acl(&mut self, device: usize, packet: &[u8]) {
        let Some((header, data)) = packet.split_first_chunk::<4>() else { return };
        let raw = u16::from_le_bytes([header[0], header[1]]);
        let Some((id, side)) = self.find_link(device, raw & 0x0FFF) else { return };
        let Some(link) = self.links.get_mut(&id) else { return };
        let first = raw >> 12 & 3 != 1;
        link.ends[side].queue.push_back(Packet { first, data: data.to_vec(), delayed: false });
        self.plan_exchange(id);
    }

    /// Link and side (0 central) of a device's connection handle.
    pub fn find_link(&self, device: usize, handle: u16) -> Option<(u32, usize)> {
        let id = *self.devices.get(device)?.handles.get(&handle)?;
        let side = usize::from(self.links.get(&id)?.ends[0].device != device);
        Some((id, side))
    }

    fn plan_exchange(&mut self, id: u32) {
        let timed = self.config.connection_events;
        let Some(link) = self.links.get_mut(&id) else { return };
        let waiting = link
            .ends
            .iter()
            .filter_map(|end| Some((end.queue.front()?, end.hold)))
            .min_by_key(|(_, hold)| *hold);
        let Some((packet, hold)) = waiting else { return };
        if link.exchange_planned {
            return;
        }
        let airtime = FRAME_SPACE + (packet.data.len() as u64 + OVERHEAD) * 8;
        let from = now_micros().max(hold);
        let at = if timed { link.event_after(from) } else { from + airtime };
        link.exchange_planned = true;
        self.at(at, Event::Exchange { link: id });
    }

    /// One connection event: each side sends what it has queued, the central first.
    pub fn exchange(&mut self, id: u32) {
        let Some(link) = self.links.get_mut(&id) else { return };
        link.exchange_planned = false;
        let devices = [link.ends[0].device, link.ends[1].device];
        let in_range = self.rssi(devices[0], devices[1]).is_some()
            && self.rssi(devices[1], devices[0]).is_some();
        if in_range {
            // Both queues as they are now: an answer waits for the next event.
            let counts = self.links.get(&id).map(|l| [0, 1].map(|s| l.ends[s].queue.len()));
            for (side, count) in counts.into_iter().flatten().enumerate() {
                for _ in 0..count {
                    if !self.deliver_one(id, side) {
                        break;
                    }
                }
            }
        }
        self.plan_exchange(id);
    }

    /// Moves the first packet of a side across; false when that side must wait.
    fn deliver_one(&mut self, id: u32, side: usize) -> bool {
        let now = now_micros();
        let Some(link) = self.links.get_mut(&id) else { return false };
        let [from, to] = [link.ends[side].device, link.ends[1 - side].device];
        let (handle, peer_handle) = (link.ends[side].handle, link.ends[1 - side].handle);
        let end = &mut link.ends[side];
        if end.hold > now {
            return false;
        }
        let Some(packet) = end.queue.front() else { return false };
        let fragment = Fragment {
            from: DeviceId(from),
            to: DeviceId(to),
            first: packet.first,
            data: &packet.data,
        };
        let fate = match &mut self.fault {
            Some(fault) if !packet.delayed => fault(&fragment),
            _ => Fate::Deliver,
        };
        if let Fate::Delay(delay) = fate {
            end.hold = now + delay.as_micros() as u64;
            end.queue.iter_mut().take(1).for_each(|p| p.delayed = true);
            return false;
        }
        let Some(packet) = end.queue.pop_front() else { return false };
        link.last_heard = now;
        let arrived = match fate {
            Fate::Deliver | Fate::Delay(_) => Some(packet.data),
            Fate::Replace(data) => Some(data),
            Fate::Lose => None,
            Fate::Kill(reason) => {
                self.drop_link(id, [reason; 2]);
                return false;
            }
        };
        self.devices[from].send(hci::completed(handle));
        if let Some(data) = arrived {
            let flags = if packet.first { 0x2000 } else { 0x1000 };
            let mut out = vec![hci::kind::ACL];
            out.extend_from_slice(&(peer_handle | flags).to_le_bytes());
            out.extend_from_slice(&(data.len() as u16).to_le_bytes());
            out.extend_from_slice(&data);
            self.devices[to].send(out);
        }
        true
    }

    /// Ends the link if its peers have not heard each other for too long.
    pub fn supervise(&mut self, id: u32) {
        let Some(link) = self.links.get(&id) else { return };
        let [a, b] = [link.ends[0].device, link.ends[1].device];
        let in_range = self.rssi(a, b).is_some() && self.rssi(b, a).is_some();
        let now = now_micros();
        let Some(link) = self.links.get_mut(&id) else { return };
        if in_range {
            link.last_heard = now;
        } else if now >= link.last_heard + link.timeout() {
            return self.drop_link(id, [status::SUPERVISION_TIMEOUT; 2]);
        }
        // Often enough to notice within a twentieth of the timeout.
        let step = (link.timeout() / 20).max(INTERVAL_UNIT);
        self.after(step, Event::Supervise { link: id });
    }

    /// Ends a link; each host is told its reason.
    pub fn drop_link(&mut self, id: u32, reasons: [u8; 2]) {
        let Some(link) = self.links.remove(&id) else { return };
        for (end, reason) in link.ends.iter().zip(reasons) {
            let device = &mut self.devices[end.device];
            if device.handles.remove(&end.handle).is_some() {
                device.send(hci::disconnected(end.handle, reason));
            }
        }
    }

    /// Plans an event for a link at its next connection event.
    fn at_next_event(&mut self, id: u32, event: Event) {
        let now = now_micros();
        let at = match self.links.get(&id) {
            Some(link) if self.config.connection_events => link.event_after(now),
            _ => now + FRAME_SPACE,
        };
        self.at(at, event);
    }

    /// A host ends a link: the other side learns of it at the next connection event.
    pub fn disconnect(&mut self, device: usize, handle: u16, reason: u8) -> u8 {
        let Some((id, side)) = self.find_link(device, handle) else {
            return status::UNKNOWN_CONNECTION;
        };
        let mut reasons = [reason; 2];
        reasons[side] = status::LOCAL_HOST_TERMINATED;
        self.at_next_event(id, Event::Drop { link: id, reasons });
        status::SUCCESS
    }

    /// The central asks for new timing.
    pub fn request_update(&mut self, device: usize, handle: u16, timing: LinkTiming) -> u8 {
        let Some((id, _)) = self.find_link(device, handle) else {
            return status::UNKNOWN_CONNECTION;
        };
        if !(6..=3200).contains(&timing.interval) || !(10..=3200).contains(&timing.timeout) {
            return status::INVALID_PARAMETERS;
        }
        self.at_next_event(id, Event::Update { link: id, timing });
        status::SUCCESS
    }

    /// New timing takes effect.
    pub fn update_link(&mut self, id: u32, timing: LinkTiming) {
        let Some(link) = self.links.get_mut(&id) else { return };
        (link.timing, link.anchor) = (timing, now_micros());
        for end in &link.ends {
            self.devices[end.device].send(hci::connection_updated(end.handle, timing));
        }
    }

    /// The central starts encryption with its key; the peripheral's host is asked for the same.
    pub fn start_encryption(
        &mut self,
        device: usize,
        handle: u16,
        rand: &[u8; 8],
        ediv: &[u8; 2],
        key: [u8; 16],
    ) -> u8 {
        let Some((id, side)) = self.find_link(device, handle) else {
            return status::UNKNOWN_CONNECTION;
        };
        let Some(link) = self.links.get_mut(&id) else { return status::UNKNOWN_CONNECTION };
        if side != 0 {
            return status::DISALLOWED;
        }
        link.offered_key = Some(key);
        let peripheral = &link.ends[1];
        let request = hci::key_request(peripheral.handle, rand, ediv);
        self.devices[peripheral.device].send(request);
        status::SUCCESS
    }

    /// The peripheral's host answers with its key, or has none. Equal keys encrypt the link, which
    /// here means no more than that both hosts are told so; different ones end it, as the message
    /// integrity check of the first packet would.
    pub fn answer_key(&mut self, device: usize, handle: u16, key: Option<[u8; 16]>) -> u8 {
        let Some((id, side)) = self.find_link(device, handle) else {
            return status::UNKNOWN_CONNECTION;
        };
        let Some(link) = self.links.get_mut(&id) else { return status::UNKNOWN_CONNECTION };
        let Some(offered) = link.offered_key.take().filter(|_| side == 1) else {
            return status::DISALLOWED;
        };
        // After the answer to the command that brought the key.
        let matches = key.map(|key| key == offered);
        self.at_next_event(id, Event::Encrypt { link: id, matches });
        status::SUCCESS
    }

    /// Tells both hosts how the comparison of keys came out (`None`: the peripheral has no key).
    pub fn encrypt(&mut self, id: u32, matches: Option<bool>) {
        let Some(link) = self.links.get_mut(&id) else { return };
        match matches {
            Some(true) => {
                let refreshed = std::mem::replace(&mut link.encrypted, true);
                for end in &link.ends {
                    let event = match refreshed {
                        true => hci::key_refreshed(end.handle),
                        false => hci::encryption_change(end.handle, status::SUCCESS, true),
                    };
                    self.devices[end.device].send(event);
                }
            }
            Some(false) => self.drop_link(id, [status::MIC_FAILURE; 2]),
            None => {
                let central = &link.ends[0];
                let event = hci::encryption_change(central.handle, status::KEY_MISSING, false);
                self.devices[central.device].send(event);
            }
        }
    }
}
