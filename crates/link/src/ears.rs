//! What was heard in a scan: beacons by address.

use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};

use bt_hci::param::{AddrKind, BdAddr, LeAdvReportsIter, LeExtAdvReportsIter};
use trouble_host::prelude::EventHandler;
use vergence_devices::{Advertisement, TagAddress};
use vergence_tag::beacon::short_id;
use vergence_tag::cbor::{self, MAX_BYTES};
use vergence_tag::{Beacon, Shown};

use crate::job::{Answer, Fault, Outcome};

#[derive(Default)]
pub(crate) struct Ears {
    heard: RefCell<BTreeMap<TagAddress, Heard>>,
    /// Tags with a public address, of all scans so far.
    public: RefCell<BTreeSet<TagAddress>>,
    /// What tags claimed to be, of all scans so far.
    claims: RefCell<BTreeMap<TagAddress, Claim>>,
}

#[derive(Default)]
struct Heard {
    beacon: Beacon,
    /// Sum and number of signal strengths, for the mean.
    rssi: i32,
    count: i32,
}

/// The object that a tag claims to belong to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Claim {
    /// Its name, perhaps the beginning of it only.
    pub name: String,
    short_id: Option<[u8; 6]>,
}

impl Claim {
    /// A record of this object is what the claim promises.
    pub fn matches(&self, object_id: &str) -> bool {
        match self.short_id {
            Some(id) => id == short_id(object_id),
            None => object_id.starts_with(&self.name),
        }
    }
}

/// A record as it was read from a tag that made this claim.
pub(crate) fn checked(mut record: Vec<u8>, claim: Option<Claim>) -> Outcome {
    if record.is_empty() {
        return Err(Fault::Refused("holds no record".into()));
    }
    record.truncate(MAX_BYTES);
    if let (Some(claim), Ok(record)) = (claim, cbor::decode(&record))
        && !claim.matches(&record.object_id)
    {
        return Err(Fault::Refused(format!(
            "advertises \"{}\" but holds the record of \"{}\"",
            Shown(&claim.name),
            record.object_id
        )));
    }
    Ok(Answer::Record(record))
}

impl Ears {
    /// Starts a new scan.
    pub fn forget(&self) {
        self.heard.borrow_mut().clear();
    }

    fn hear(&self, kind: AddrKind, address: BdAddr, data: &[u8], rssi: i8) {
        let mut bytes = address.into_inner();
        bytes.reverse();
        let tag = TagAddress(bytes);
        self.hear_strength(tag, rssi);
        if kind.as_raw() & 1 == 0 {
            self.public.borrow_mut().insert(tag);
        } else {
            self.public.borrow_mut().remove(&tag);
        }
        self.hear_data(tag, data);
    }

    /// A packet came this strong (dBm).
    pub fn hear_strength(&self, tag: TagAddress, rssi: i8) {
        let mut all = self.heard.borrow_mut();
        let heard = all.entry(tag).or_default();
        // 127: the controller cannot tell.
        if rssi <= 20 {
            heard.rssi += i32::from(rssi);
            heard.count += 1;
        }
    }

    /// A packet, or a part of one, said this.
    pub fn hear_data(&self, tag: TagAddress, data: &[u8]) {
        let mut all = self.heard.borrow_mut();
        let heard = all.entry(tag).or_default();
        heard.beacon.hear(data);
        if let Some(name) = heard.beacon.object_id() {
            let claim = Claim { name: name.into(), short_id: heard.beacon.short_id };
            self.claims.borrow_mut().insert(tag, claim);
        }
    }

    /// The tags of this scan, strongest first.
    pub fn tags(&self) -> Vec<Advertisement> {
        let heard = self.heard.borrow();
        let mut tags: Vec<Advertisement> = heard
            .iter()
            .filter(|(_, h)| h.beacon.is_tag)
            .filter_map(|(address, h)| {
                Some(Advertisement {
                    address: *address,
                    object_id: h.beacon.object_id()?.to_owned(),
                    rssi: h.rssi.checked_div(h.count).map_or(i8::MIN, |mean| mean as i8),
                    battery: h.beacon.battery,
                })
            })
            .collect();
        tags.sort_by_key(|tag| (std::cmp::Reverse(tag.rssi), tag.address));
        tags
    }

    /// The tag was heard with a public address; all others are taken for random ones.
    pub fn is_public(&self, tag: TagAddress) -> bool {
        self.public.borrow().contains(&tag)
    }

    /// The tag holds another record now: what it claimed to be no longer counts.
    pub fn rewritten(&self, tag: TagAddress) {
        self.claims.borrow_mut().remove(&tag);
    }

    /// What the tag claims to be.
    pub fn object_id(&self, tag: TagAddress) -> Option<Claim> {
        self.claims.borrow().get(&tag).cloned()
    }
}

impl EventHandler for Ears {
    fn on_adv_reports(&self, reports: LeAdvReportsIter<'_>) {
        // A report that cannot be read ends the event; the next one brings the tag again.
        for report in reports.map_while(Result::ok) {
            self.hear(report.addr_kind, report.addr, report.data, report.rssi);
        }
    }

    fn on_ext_adv_reports(&self, reports: LeExtAdvReportsIter<'_>) {
        for report in reports.map_while(Result::ok) {
            self.hear(report.addr_kind, report.addr, report.data, report.rssi);
        }
    }
}
