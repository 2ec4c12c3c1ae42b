//! The tag's attribute server: the table of [`vergence_tag::gatt`] on trouble-host.
//!
//! The tag service comes first in the table, so that one request of a robot finds all of it.

use embassy_sync::blocking_mutex::raw::NoopRawMutex;
use trouble_host::PacketPool;
use trouble_host::attribute::{
    AttributeTable, Characteristic, CharacteristicProp, PermissionLevel, Service, Uuid,
};
use trouble_host::prelude::appearance;
use trouble_host::prelude::{AttributeServer, GapConfig, GattConnection, PeripheralConfig};
use vergence_tag::State;
use vergence_tag::command::MAX_COMMAND_BYTES;
use vergence_tag::gatt::{self, LONGEST_VALUE};
use vergence_tag::upload::PIECE;

use crate::config::{Access, Config};

/// Attributes of all services, with some room for what trouble-host adds.
const ATTRIBUTES: usize = 40;
const UPLOAD_BYTES: usize = PIECE + 2;

type Value = heapless::Vec<u8, LONGEST_VALUE>;

/// Memory of the values that the table refers to.
pub struct Values {
    record: [u8; LONGEST_VALUE],
    rest: [u8; LONGEST_VALUE],
    upload: [u8; UPLOAD_BYTES],
}

impl Default for Values {
    fn default() -> Self {
        Values { record: [0; LONGEST_VALUE], rest: [0; LONGEST_VALUE], upload: [0; UPLOAD_BYTES] }
    }
}

/// The server and the handles that the firmware itself needs.
pub struct Server<'v, P: PacketPool> {
    /// What trouble-host serves.
    pub attributes: AttributeServer<'v, NoopRawMutex, P, ATTRIBUTES, 1>,
    record: Characteristic<Value>,
    rest: Characteristic<Value>,
    upload: Characteristic<heapless::Vec<u8, UPLOAD_BYTES>>,
    command: Characteristic<heapless::Vec<u8, MAX_COMMAND_BYTES>>,
    state: Characteristic<[u8; 2]>,
    battery: Characteristic<u8>,
}

/// What a write is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Target {
    /// A piece or the commit of a new record.
    Upload,
    /// A command to the LED.
    Command,
}

fn level(access: Access) -> PermissionLevel {
    match access {
        Access::Open => PermissionLevel::Allowed,
        Access::Encrypted => PermissionLevel::EncryptionRequired,
        Access::Authenticated => PermissionLevel::AuthenticationRequired,
    }
}

impl<'v, P: PacketPool> Server<'v, P> {
    /// Builds the table.
    pub fn new(values: &'v mut Values, config: &Config<'v>) -> Self {
        use CharacteristicProp::{Notify, Read, Write};
        let mut table: AttributeTable<'v, NoopRawMutex, ATTRIBUTES> = AttributeTable::new();
        let uuid = |uuid: u128| Uuid::new_long(uuid.to_le_bytes());
        let (reads, writes) = (level(config.record_access), level(config.write_access));
        let commands = level(config.command_access);

        let mut tag = table.add_service(Service::new(uuid(gatt::SERVICE)));
        let record = tag
            .add_characteristic(uuid(gatt::RECORD), [Read], Value::new(), &mut values.record)
            .read_permission(reads)
            .build();
        let rest = tag
            .add_characteristic(uuid(gatt::RECORD_REST), [Read], Value::new(), &mut values.rest)
            .read_permission(reads)
            .build();
        let empty = heapless::Vec::new();
        let upload = tag
            .add_characteristic(uuid(gatt::RECORD_WRITE), [Write], empty, &mut values.upload)
            .write_permission(writes)
            .build();
        let command = tag
            .add_characteristic_small(uuid(gatt::COMMAND), [Write], heapless::Vec::new())
            .write_permission(commands)
            .build();
        let state = tag
            .add_characteristic_small(uuid(gatt::STATE), [Read, Notify], State::default().encode())
            .build();
        tag.build();

        let gap = PeripheralConfig { name: "Vergence tag", appearance: &appearance::UNKNOWN };
        // Fails only for names longer than 22 bytes.
        let _ = GapConfig::Peripheral(gap).build(&mut table);
        let mut information =
            table.add_service(Service::new(Uuid::new_short(gatt::DEVICE_INFORMATION)));
        for (kind, text) in [
            (gatt::MANUFACTURER, "Vergence"),
            (gatt::MODEL, config.model),
            (gatt::FIRMWARE, env!("CARGO_PKG_VERSION")),
        ] {
            information.add_characteristic_ro(Uuid::new_short(kind), text).build();
        }
        information.build();
        let mut battery_service = table.add_service(Service::new(Uuid::new_short(gatt::BATTERY)));
        let battery = battery_service
            .add_characteristic_small(Uuid::new_short(gatt::BATTERY_LEVEL), [Read, Notify], 0u8)
            .build();
        battery_service.build();

        let attributes = AttributeServer::new(table);
        Server { attributes, record, rest, upload, command, state, battery }
    }

    /// Serves this record from now on.
    pub fn set_record(&self, record: &[u8]) {
        let split = record.len().min(LONGEST_VALUE);
        let table = self.attributes.table();
        for (characteristic, part) in
            [(&self.record, &record[..split]), (&self.rest, &record[split..])]
        {
            // Records have 1024 bytes at most: both halves fit.
            if let Ok(value) = Value::from_slice(part) {
                let _ = table.set(characteristic, &value);
            }
        }
    }

    /// Serves this state from now on.
    pub fn set_state(&self, state: State) {
        let table = self.attributes.table();
        let _ = table.set(&self.state, &state.encode());
        // The standard has no "unknown"; an empty battery is the careful answer.
        let _ = table.set(&self.battery, &state.battery.unwrap_or(0));
    }

    /// Tells a subscribed robot the state.
    pub async fn notify(&self, connection: &GattConnection<'_, '_, P>, state: State) {
        if self.state.should_notify(connection) {
            // A robot that is gone or does not read need not be told.
            let _ = self.state.notify_raw(connection, &state.encode(), false).await;
        }
    }

    /// What a write to this handle is for; `None` for attributes that trouble-host handles itself.
    pub fn target(&self, handle: u16) -> Option<Target> {
        match handle {
            h if h == self.upload.handle => Some(Target::Upload),
            h if h == self.command.handle => Some(Target::Command),
            _ => None,
        }
    }
}
