//! What robot and tag say to each other over one link: attributes read and written.
//!
//! Record, state and texts are asked for by their UUID, which one request answers together with the
//! value. Writes need a handle; the tag tells it once, in one more request, and the robot keeps it by
//! the tag's address. A tag that was flashed anew may have its attributes elsewhere. Asking whether
//! that is so would cost as much as asking for the handles; instead, whatever does not come out as it
//! must (an error, a light that does not play) is done once more with handles that are asked for anew.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::ops::ControlFlow;

use bt_hci::uuid::declarations::CHARACTERISTIC;
use embassy_futures::select::{Either, select};
use trouble_host::Controller;
use trouble_host::attribute::Uuid;
use trouble_host::connection::Connection;
use trouble_host::gatt::GattClient;
use vergence_devices::{TagAddress, TagState};
use vergence_firmware::Guard;
use vergence_tag::gatt::{self, LONGEST_VALUE};
use vergence_tag::{Command, State, Upload};

use crate::central::{Host, LINKS};
use crate::ears::{Ears, checked};
use crate::job::{Answer, Fault, Outcome, TagInfo, Task};
use crate::pool::HeapPool;

/// Where a tag takes its writes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Handles {
    upload: u16,
    command: u16,
}

/// The handles of all tags that the robot wrote to.
#[derive(Default)]
pub(crate) struct KnownHandles(RefCell<BTreeMap<TagAddress, Handles>>);

struct Conversation<'r, 'a, 's, C: Controller> {
    stack: &'r Host<'s, C>,
    client: GattClient<'a, Guard<C, LINKS>, HeapPool, 4>,
    connection: &'r Connection<'a, HeapPool>,
    ears: &'r Ears,
    known: &'r KnownHandles,
    tag: TagAddress,
}

/// Carries out a task over a link.
pub(crate) async fn hold<'a, 's, C: Controller>(
    stack: &'a Host<'s, C>,
    connection: &Connection<'a, HeapPool>,
    ears: &Ears,
    known: &KnownHandles,
    tag: TagAddress,
    task: &Task,
) -> Outcome {
    let client = GattClient::new(stack, connection).await.map_err(Fault::of)?;
    let conversation = Conversation { stack, client, connection, ears, known, tag };
    let work = async {
        match task {
            Task::Record => conversation.read_record().await,
            Task::Info => conversation.info().await,
            Task::Command(_) | Task::Write(_) => conversation.write(task).await,
            // These need no conversation.
            Task::Pair(_) | Task::Release => Ok(Answer::Done),
        }
    };
    match select(conversation.client.task(), work).await {
        Either::First(Ok(())) => Err(Fault::Lost),
        Either::First(Err(error)) => Err(Fault::of(error)),
        Either::Second(outcome) => outcome,
    }
}

fn uuid(uuid: u128) -> Uuid {
    Uuid::new_long(uuid.to_le_bytes())
}

impl<C: Controller> Conversation<'_, '_, '_, C> {
    /// Handle and first bytes of the first attribute of a type.
    async fn find(&self, kind: &Uuid) -> Result<Option<(u16, Vec<u8>)>, Fault> {
        self.client
            .read_by_type(1, u16::MAX, kind, |handle, value| {
                ControlFlow::Break((handle, value.to_vec()))
            })
            .await
            .map_err(Fault::of)
    }

    /// A whole attribute value: one request for short ones, no search for its handle before.
    async fn read(&self, kind: u128) -> Result<Vec<u8>, Fault> {
        let Some((handle, mut value)) = self.find(&uuid(kind)).await? else {
            return Err(no_tag());
        };
        // What fits the answer besides opcode, length and handle; the length has one byte.
        let fits = usize::from(self.connection.att_mtu()).saturating_sub(4).min(253);
        if value.len() >= fits {
            let at = value.len();
            value.resize(LONGEST_VALUE.max(at), 0);
            let more = self.client.read_handle_blob(handle, at as u16, &mut value[at..]);
            let more = more.await.map_err(Fault::of)?;
            value.truncate(at + more);
        }
        Ok(value)
    }

    async fn read_record(&self) -> Outcome {
        let mut record = self.read(gatt::RECORD).await?;
        if record.len() >= LONGEST_VALUE {
            record.extend(self.read(gatt::RECORD_REST).await?);
        }
        checked(record, self.ears.object_id(self.tag))
    }

    async fn info(&self) -> Outcome {
        let mut texts = [const { String::new() }; 3];
        for (text, kind) in texts.iter_mut().zip([gatt::MANUFACTURER, gatt::MODEL, gatt::FIRMWARE])
        {
            let value = self.find(&Uuid::new_short(kind)).await?;
            *text =
                value.map(|(_, v)| String::from_utf8_lossy(&v).into_owned()).unwrap_or_default();
        }
        let [manufacturer, model, firmware] = texts;
        let state = self.state().await?;
        Ok(Answer::Info(TagInfo {
            manufacturer,
            model,
            firmware,
            battery: state.battery,
            has_record: state.has_record,
            playing: state.playing,
            rssi: self.connection.rssi(self.stack).await.ok().filter(|rssi| *rssi < 20),
        }))
    }

    async fn state(&self) -> Result<State, Fault> {
        let Some((_, bytes)) = self.find(&uuid(gatt::STATE)).await? else { return Err(no_tag()) };
        State::decode(&bytes).ok_or(Fault::Refused("tells no state".into()))
    }

    /// A task that writes: with the handles of an earlier link if there are any and they still hold,
    /// else with those that the tag tells.
    async fn write(&self, task: &Task) -> Outcome {
        let known = self.known.0.borrow().get(&self.tag).copied();
        if let Some(handles) = known {
            match self.write_to(handles, task).await {
                Ok(answer) if came_true(task, &answer) => return Ok(answer),
                Err(Fault::Lost) => return Err(Fault::Lost),
                _ => self.known.0.borrow_mut().remove(&self.tag),
            };
        }
        let handles = self.ask_handles().await?;
        let outcome = self.write_to(handles, task).await?;
        self.known.0.borrow_mut().insert(self.tag, handles);
        Ok(outcome)
    }

    async fn write_to(&self, handles: Handles, task: &Task) -> Outcome {
        match task {
            Task::Command(command) => {
                let written = self.client.write_handle(handles.command, &command.encode()).await;
                written.map_err(Fault::of)?;
                let State { playing, battery, .. } = self.state().await?;
                Ok(Answer::State(TagState { playing, battery }))
            }
            Task::Write(record) => {
                // Also when the answer to the last piece is lost.
                self.ears.rewritten(self.tag);
                for message in Upload::messages(record) {
                    let written = self.client.write_handle(handles.upload, &message).await;
                    written.map_err(Fault::of)?;
                }
                Ok(Answer::Done)
            }
            _ => Ok(Answer::Done),
        }
    }

    /// The tag's handles in one request, or two when it is not ours.
    async fn ask_handles(&self) -> Result<Handles, Fault> {
        let mut found = Handles::default();
        let declarations = |_: u16, declaration: &[u8]| {
            // Properties, handle of the value, UUID.
            let Some(([_, low, high], kind)) = declaration.split_first_chunk::<3>() else {
                return ControlFlow::Continue(());
            };
            let handle = u16::from_le_bytes([*low, *high]);
            for (wanted, slot) in
                [(gatt::RECORD_WRITE, &mut found.upload), (gatt::COMMAND, &mut found.command)]
            {
                if kind == wanted.to_le_bytes() {
                    *slot = handle;
                }
            }
            match found.upload > 0 && found.command > 0 {
                true => ControlFlow::Break(()),
                false => ControlFlow::Continue(()),
            }
        };
        let kind = CHARACTERISTIC.into();
        let searched = self.client.read_by_type(1, u16::MAX, &kind, declarations);
        searched.await.map_err(Fault::of)?.ok_or_else(no_tag)?;
        Ok(found)
    }
}

/// The tag does what it was told to.
fn came_true(task: &Task, answer: &Answer) -> bool {
    match (task, answer) {
        (Task::Command(Command::Play { .. }), Answer::State(state)) => state.playing,
        (Task::Command(Command::Stop), Answer::State(state)) => !state.playing,
        _ => true,
    }
}

fn no_tag() -> Fault {
    Fault::Refused("is no tag: it lacks the tag service".into())
}
