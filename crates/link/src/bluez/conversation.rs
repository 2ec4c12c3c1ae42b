//! Work on a tag over a link that stands.

use std::collections::HashMap;

use bluer::gatt::WriteOp;
use bluer::gatt::remote::{Characteristic, CharacteristicWriteRequest};
use bluer::{Device, Uuid};
use vergence_devices::TagState;
use vergence_tag::gatt::{self, LONGEST_VALUE};
use vergence_tag::{State, Upload};

use super::fault::fault;
use crate::ears::{Claim, checked};
use crate::job::{Answer, Fault, Outcome, TagInfo, Task};

/// A tag's characteristics by their UUIDs.
struct Server(HashMap<Uuid, Characteristic>);

/// Carries out a task on a tag that claimed to be an object, if it was heard.
pub(super) async fn converse(device: &Device, task: &Task, claim: Option<Claim>) -> Outcome {
    let server = Server::discover(device).await?;
    match task {
        Task::Record => server.record(claim).await,
        Task::Info => server.info(device).await,
        Task::Command(command) => {
            server.write(gatt::COMMAND, &command.encode()).await?;
            let state = server.state().await?;
            Ok(Answer::State(TagState { playing: state.playing, battery: state.battery }))
        }
        Task::Write(record) => {
            for message in Upload::messages(record) {
                server.write(gatt::RECORD_WRITE, &message).await?;
            }
            Ok(Answer::Done)
        }
        // These need no conversation.
        Task::Pair(_) | Task::Release => Ok(Answer::Done),
    }
}

impl Server {
    async fn discover(device: &Device) -> Result<Self, Fault> {
        let mut found = HashMap::new();
        for service in device.services().await.map_err(fault)? {
            for characteristic in service.characteristics().await.map_err(fault)? {
                let uuid = characteristic.uuid().await.map_err(fault)?;
                found.insert(uuid, characteristic);
            }
        }
        Ok(Server(found))
    }

    fn get(&self, uuid: u128) -> Result<&Characteristic, Fault> {
        self.0
            .get(&Uuid::from_u128(uuid))
            .ok_or_else(|| Fault::Refused("is no tag: it lacks the tag service".into()))
    }

    async fn read(&self, uuid: u128) -> Result<Vec<u8>, Fault> {
        self.get(uuid)?.read().await.map_err(fault)
    }

    async fn write(&self, uuid: u128, value: &[u8]) -> Result<(), Fault> {
        let request =
            CharacteristicWriteRequest { op_type: WriteOp::Request, ..Default::default() };
        self.get(uuid)?.write_ext(value, &request).await.map_err(fault)
    }

    async fn state(&self) -> Result<State, Fault> {
        State::decode(&self.read(gatt::STATE).await?).ok_or(Fault::Refused("tells no state".into()))
    }

    async fn record(&self, claim: Option<Claim>) -> Outcome {
        let mut record = self.read(gatt::RECORD).await?;
        if record.len() >= LONGEST_VALUE {
            record.extend(self.read(gatt::RECORD_REST).await?);
        }
        checked(record, claim)
    }

    async fn info(&self, device: &Device) -> Outcome {
        let mut texts = [const { String::new() }; 3];
        for (text, kind) in texts.iter_mut().zip([gatt::MANUFACTURER, gatt::MODEL, gatt::FIRMWARE])
        {
            const BASE: u128 = 0x0000_0000_0000_1000_8000_0080_5F9B_34FB;
            if let Ok(characteristic) = self.get(BASE | u128::from(kind) << 96) {
                let value = characteristic.read().await.map_err(fault)?;
                *text = String::from_utf8_lossy(&value).into_owned();
            }
        }
        let [manufacturer, model, firmware] = texts;
        let state = self.state().await?;
        // Told while scanning only.
        let rssi = device.rssi().await.ok().flatten().and_then(|rssi| rssi.try_into().ok());
        Ok(Answer::Info(TagInfo {
            manufacturer,
            model,
            firmware,
            battery: state.battery,
            has_record: state.has_record,
            playing: state.playing,
            rssi,
        }))
    }
}
