//! Advertising, scanning and the making of connections (legacy advertising, one set a device).

use rand::RngExt;

use crate::hci::{self, Address, LinkTiming, status};
use crate::medium::{Event, Medium, now_micros};

/// Microseconds of a slot, the unit of advertising and scan intervals.
const SLOT: u64 = 625;
/// Largest random addition to an advertising interval (us): advDelay.
const ADVERTISING_DELAY: u64 = 10_000;

/// Report types, which are the advertising types too, but for the scan response.
const CONNECTABLE: u8 = 0;
const SCANNABLE: u8 = 2;
const SCAN_RESPONSE: u8 = 4;

#[derive(Default)]
pub(crate) struct Advertising {
    enabled: bool,
    /// Changes with every start, so that events of an earlier start are recognised.
    generation: u32,
    /// Interval (us).
    interval: u64,
    /// ADV_IND 0, ADV_DIRECT_IND 1 and 4, ADV_SCAN_IND 2, ADV_NONCONN_IND 3.
    kind: u8,
    own_address: u8,
    data: Vec<u8>,
    scan_response: Vec<u8>,
}

impl Advertising {
    /// As after a reset; events that are under way no longer count.
    pub fn stopped(&self) -> Self {
        Advertising { generation: self.generation + 1, ..Advertising::default() }
    }
}

#[derive(Default)]
pub(crate) struct Scanning {
    enabled: bool,
    active: bool,
    filtered: bool,
    unique: bool,
    /// Interval and window (us); the window begins with each interval.
    interval: u64,
    window: u64,
    started: u64,
    seen: Vec<(Address, u8)>,
}

impl Scanning {
    fn listens(&self, now: u64) -> bool {
        self.enabled && (now - self.started) % self.interval.max(1) < self.window.max(1)
    }
}

pub(crate) struct Initiating {
    /// `None`: anybody on the accept list.
    peer: Option<Address>,
    own_address: u8,
    timing: LinkTiming,
}

fn word(parameters: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([parameters[at], parameters[at + 1]])
}

fn address(parameters: &[u8], at: usize) -> Address {
    let mut bytes = [0; 6];
    bytes.copy_from_slice(&parameters[at + 1..at + 7]);
    // Kinds 2 and 3 are identities that were resolved; the address is of kind 0 or 1.
    Address { kind: parameters[at] & 1, bytes }
}

impl Medium {
    /// LE Set Advertising Parameters.
    pub fn set_advertising(&mut self, device: usize, parameters: &[u8; 15]) -> u8 {
        let advertising = &mut self.devices[device].advertising;
        if advertising.enabled {
            return status::DISALLOWED;
        }
        let (shortest, longest) = (word(parameters, 0), word(parameters, 2));
        let directed_fast = parameters[4] == 1;
        if !directed_fast && (!(0x20..=0x4000).contains(&shortest) || shortest > longest) {
            return status::INVALID_PARAMETERS;
        }
        advertising.interval = if directed_fast { 3_750 } else { u64::from(longest) * SLOT };
        (advertising.kind, advertising.own_address) = (parameters[4], parameters[5]);
        status::SUCCESS
    }

    /// LE Set Advertising Data and LE Set Scan Response Data: a length and 31 bytes.
    pub fn set_advertising_data(&mut self, device: usize, parameters: &[u8], response: bool) -> u8 {
        let data = parameters.split_first().and_then(|(length, d)| d.get(..usize::from(*length)));
        let Some(data) = data.filter(|d| d.len() <= 31) else { return status::INVALID_PARAMETERS };
        let advertising = &mut self.devices[device].advertising;
        match response {
            false => advertising.data = data.to_vec(),
            true => advertising.scan_response = data.to_vec(),
        }
        status::SUCCESS
    }

    /// LE Set Advertising Enable.
    pub fn enable_advertising(&mut self, device: usize, on: bool) -> u8 {
        let delay = self.rng.random_range(0..ADVERTISING_DELAY);
        let advertising = &mut self.devices[device].advertising;
        if on && !advertising.enabled {
            advertising.generation += 1;
            let generation = advertising.generation;
            self.after(delay, Event::Advertise { device, generation });
        }
        self.devices[device].advertising.enabled = on;
        status::SUCCESS
    }

    /// LE Set Scan Parameters.
    pub fn set_scanning(&mut self, device: usize, parameters: &[u8; 7]) -> u8 {
        let scanning = &mut self.devices[device].scanning;
        let (interval, window) = (word(parameters, 1), word(parameters, 3));
        if scanning.enabled {
            return status::DISALLOWED;
        }
        if window > interval || window < 4 {
            return status::INVALID_PARAMETERS;
        }
        scanning.active = parameters[0] == 1;
        (scanning.interval, scanning.window) =
            (u64::from(interval) * SLOT, u64::from(window) * SLOT);
        scanning.filtered = parameters[6] & 1 == 1;
        status::SUCCESS
    }

    /// LE Set Scan Enable.
    pub fn enable_scanning(&mut self, device: usize, on: bool, unique: bool) -> u8 {
        let scanning = &mut self.devices[device].scanning;
        if on && !scanning.enabled {
            scanning.started = now_micros();
            scanning.seen.clear();
        }
        (scanning.enabled, scanning.unique) = (on, unique);
        status::SUCCESS
    }

    /// LE Create Connection.
    pub fn create_connection(&mut self, device: usize, parameters: &[u8; 25]) -> u8 {
        let device = &mut self.devices[device];
        if device.initiating.is_some() {
            return status::DISALLOWED;
        }
        let timing = LinkTiming {
            interval: word(parameters, 15),
            latency: word(parameters, 17),
            timeout: word(parameters, 19),
        };
        if !(6..=3200).contains(&timing.interval) || !(10..=3200).contains(&timing.timeout) {
            return status::INVALID_PARAMETERS;
        }
        let peer = (parameters[4] == 0).then(|| address(parameters, 5));
        device.initiating = Some(Initiating { peer, own_address: parameters[12], timing });
        status::SUCCESS
    }

    /// LE Create Connection Cancel; the host is told that there will be no connection.
    pub fn cancel_connection(&mut self, device: usize) -> u8 {
        match self.devices[device].initiating.take() {
            Some(_) => status::SUCCESS,
            None => status::DISALLOWED,
        }
    }

    /// One advertising event: scanners report it, and an initiator answers it with a connection.
    pub fn advertise(&mut self, device: usize, generation: u32) {
        let advertiser = &self.devices[device];
        let advertising = &advertiser.advertising;
        if !advertiser.powered || !advertising.enabled || advertising.generation != generation {
            return;
        }
        let from = advertiser.own_address(advertising.own_address);
        let kind = advertising.kind;
        let (data, response) = (advertising.data.clone(), advertising.scan_response.clone());
        let interval = advertising.interval;
        for listener in (0..self.devices.len()).filter(|l| *l != device) {
            let Some(rssi) = self.rssi(device, listener) else { continue };
            self.hear(listener, kind, from, [&data, &response], rssi);
        }
        if matches!(kind, 0 | 1 | 4) && self.answer(device, from) {
            return;
        }
        let delay = interval + self.rng.random_range(0..ADVERTISING_DELAY);
        self.after(delay, Event::Advertise { device, generation });
    }

    /// A scanner hears an advertisement and, scanning actively, asks for the scan response.
    fn hear(&mut self, listener: usize, kind: u8, from: Address, data: [&[u8]; 2], rssi: i8) {
        let listener = &mut self.devices[listener];
        let scanning = &mut listener.scanning;
        if !scanning.listens(now_micros())
            || scanning.filtered && !listener.accept_list.contains(&from)
        {
            return;
        }
        let asks = scanning.active && matches!(kind, CONNECTABLE | SCANNABLE);
        let reports = [(kind, data[0])].into_iter().chain(asks.then_some((SCAN_RESPONSE, data[1])));
        for (kind, data) in reports {
            if scanning.unique && scanning.seen.contains(&(from, kind)) {
                continue;
            }
            if scanning.unique {
                scanning.seen.push((from, kind));
            }
            let report = hci::advertising_report(kind, from, data, rssi);
            listener.to_host.push_back(report);
        }
        listener.wake();
    }

    /// Connects an initiator that waits for this advertiser; of several the fastest, which is a
    /// matter of chance.
    fn answer(&mut self, advertiser: usize, from: Address) -> bool {
        let answers = |other: &usize| {
            let candidate = &self.devices[*other];
            let wanted = candidate.initiating.as_ref().is_some_and(|i| match i.peer {
                Some(peer) => peer == from,
                None => candidate.accept_list.contains(&from),
            });
            let both_ways = || {
                self.rssi(advertiser, *other).is_some() && self.rssi(*other, advertiser).is_some()
            };
            *other != advertiser && wanted && both_ways()
        };
        let initiators: Vec<usize> = (0..self.devices.len()).filter(answers).collect();
        let initiator = match initiators[..] {
            [] => return false,
            [only] => only,
            _ => initiators[self.rng.random_range(0..initiators.len())],
        };
        let Some(Initiating { own_address, timing, .. }) =
            self.devices[initiator].initiating.take()
        else {
            return false;
        };
        self.devices[advertiser].advertising.enabled = false;
        let own = self.devices[initiator].own_address(own_address);
        self.connect([initiator, advertiser], [own, from], timing);
        true
    }
}
