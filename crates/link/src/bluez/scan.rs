//! Listening: what BlueZ tells of devices, brought back to the form in which tags say it.

use std::collections::{HashMap, HashSet};
use std::time::Duration;

use bluer::{
    Adapter, AdapterEvent, Address, Device, DeviceEvent, DeviceProperty, DiscoveryFilter,
    DiscoveryTransport, Uuid,
};
use futures::StreamExt;
use futures::stream::SelectAll;
use tokio::time::{Instant, timeout_at};
use vergence_devices::TagAddress;

use crate::ears::Ears;

/// Low Energy, every packet.
pub(super) fn filter() -> DiscoveryFilter {
    DiscoveryFilter {
        transport: DiscoveryTransport::Le,
        duplicate_data: true,
        ..DiscoveryFilter::default()
    }
}

/// Listens for a whole window; what is heard of each address goes to `ears`.
pub(super) async fn scan(adapter: &Adapter, ears: &Ears, window: Duration) -> bluer::Result<()> {
    ears.forget();
    adapter.set_discovery_filter(filter()).await?;
    let mut found = Box::pin(adapter.discover_devices().await?);
    let end = Instant::now() + window;
    let mut changes = SelectAll::new();
    let mut followed = HashSet::new();
    // A device without a signal strength is one that BlueZ remembers.
    let mut present = HashSet::new();
    loop {
        let news = async {
            tokio::select! {
                event = found.next() => event.map(News::Found),
                Some((address, property)) = changes.next(), if !changes.is_empty() => {
                    Some(News::Change(address, property))
                }
            }
        };
        let Ok(Some(news)) = timeout_at(end, news).await else { break };
        let arrived = match news {
            News::Found(AdapterEvent::DeviceAdded(address)) if followed.insert(address) => {
                let device = adapter.device(address)?;
                let follow = device.events().await?.map(move |event| {
                    let DeviceEvent::PropertyChanged(property) = event;
                    (address, property)
                });
                changes.push(Box::pin(follow));
                device.rssi().await.ok().flatten().map(|_| address)
            }
            News::Change(address, property) if present.contains(&address) => {
                hear(ears, address, &property);
                None
            }
            News::Change(address, DeviceProperty::Rssi(_)) => Some(address),
            _ => None,
        };
        if let Some(address) = arrived.filter(|address| present.insert(*address)) {
            for property in properties(&adapter.device(address)?).await {
                hear(ears, address, &property);
            }
        }
    }
    // A daemon that ended the discovery by itself still gave us what it gave.
    tokio::time::sleep_until(end).await;
    Ok(())
}

enum News {
    Found(AdapterEvent),
    Change(Address, DeviceProperty),
}

fn tag(address: Address) -> TagAddress {
    TagAddress(address.0)
}

/// What BlueZ knows of a device by now; it may be gone while we ask.
async fn properties(device: &Device) -> Vec<DeviceProperty> {
    let mut properties = Vec::new();
    properties.extend(device.rssi().await.ok().flatten().map(DeviceProperty::Rssi));
    properties.extend(device.uuids().await.ok().flatten().map(DeviceProperty::Uuids));
    let data = device.manufacturer_data().await.ok().flatten();
    properties.extend(data.map(DeviceProperty::ManufacturerData));
    properties.extend(device.name().await.ok().flatten().map(DeviceProperty::Name));
    let data = device.service_data().await.ok().flatten();
    properties.extend(data.map(DeviceProperty::ServiceData));
    properties
}

fn hear(ears: &Ears, address: Address, property: &DeviceProperty) {
    match property {
        DeviceProperty::Rssi(rssi) => {
            let rssi = (*rssi).clamp(i16::from(i8::MIN), i16::from(i8::MAX)) as i8;
            ears.hear_strength(tag(address), rssi);
        }
        property => ears.hear_data(tag(address), &packet(property)),
    }
}

/// The structures of an advertisement (Core Specification Supplement, part A) that say this.
fn packet(property: &DeviceProperty) -> Vec<u8> {
    let mut packet = Vec::new();
    let mut add = |kind: u8, parts: &[&[u8]]| {
        let length = 1 + parts.iter().map(|part| part.len()).sum::<usize>();
        // Longer ones no tag sends.
        if let Ok(length) = u8::try_from(length) {
            packet.extend([length, kind]);
            packet.extend(parts.concat());
        }
    };
    match property {
        DeviceProperty::Uuids(uuids) => {
            for uuid in uuids {
                add(0x07, &[&uuid.as_u128().to_le_bytes()]);
            }
        }
        DeviceProperty::Name(name) => add(0x09, &[name.as_bytes()]),
        DeviceProperty::ManufacturerData(data) => {
            for (company, data) in sorted(data) {
                add(0xFF, &[&company.to_le_bytes(), data]);
            }
        }
        DeviceProperty::ServiceData(data) => {
            for (service, data) in sorted(data) {
                add(0x16, &[&short(service).to_le_bytes(), data]);
            }
        }
        _ => {}
    }
    packet
}

/// The 16 bits by which the Bluetooth SIG's own services go; other services give nonsense that no
/// tag's data start with.
fn short(service: &Uuid) -> u16 {
    const BASE: u128 = 0x0000_0000_0000_1000_8000_0080_5F9B_34FB;
    let bits = service.as_u128() ^ BASE;
    u16::try_from(bits >> 96).ok().filter(|_| bits << 32 == 0).unwrap_or(0)
}

fn sorted<K: Ord, V>(map: &HashMap<K, V>) -> Vec<(&K, &V)> {
    let mut entries: Vec<_> = map.iter().collect();
    entries.sort_by_key(|(key, _)| *key);
    entries
}

#[cfg(test)]
mod tests {
    use vergence_tag::{Beacon, beacon, gatt};

    use super::*;

    #[test]
    fn a_tag_is_known_by_what_bluez_tells_of_it() {
        let mut heard = Beacon::default();
        let short_id = beacon::short_id("cup").to_vec();
        let bthome = Uuid::from_u128(0x0000_FCD2_0000_1000_8000_0080_5F9B_34FB);
        for property in [
            DeviceProperty::Uuids(HashSet::from([
                Uuid::from_u128(0x0000_180F_0000_1000_8000_0080_5F9B_34FB),
                Uuid::from_u128(gatt::SERVICE),
            ])),
            DeviceProperty::ManufacturerData(HashMap::from([(0xFFFF, short_id)])),
            DeviceProperty::Name("cup".into()),
            DeviceProperty::ServiceData(HashMap::from([
                (bthome, vec![0x40, 0x01, 80, 0x0F, 1]),
                (Uuid::from_u128(7), vec![0; 300]),
            ])),
        ] {
            heard.hear(&packet(&property));
        }
        let mut truth = Beacon::default();
        truth.hear(&beacon::advertisement("cup"));
        truth.hear(&beacon::scan_response("cup", Some(80), true));
        assert_eq!(heard, truth);
    }
}
