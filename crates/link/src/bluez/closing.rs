//! Links after use. BlueZ takes two seconds to end one; nobody should wait for that, and nobody may
//! use a link that is about to end.

use std::collections::BTreeMap;
use std::time::Duration;

use bluer::Device;
use tokio::sync::oneshot;
use tokio::task::JoinHandle;
use tokio::time::{sleep, timeout};
use vergence_devices::TagAddress;

/// How long a link stays for the next task on the same tag: a record is read, then the light switched
/// on.
const LINGER: Duration = Duration::from_secs(3);
/// Bound on the end of a link.
const END: Duration = Duration::from_secs(5);

/// What becomes of a link that lingers.
enum Fate {
    Keep,
    EndNow,
}

struct Lingering {
    fate: oneshot::Sender<Fate>,
    task: JoinHandle<()>,
}

/// Links that linger or end.
#[derive(Default)]
pub(super) struct Closing(BTreeMap<TagAddress, Lingering>);

impl Closing {
    /// Lets a link linger, then ends it. Must be called on the runtime.
    pub fn after_use(&mut self, tag: TagAddress, device: Device) {
        let (fate, told) = oneshot::channel();
        let task = tokio::spawn(async move {
            if let Ok(Ok(Fate::Keep)) = timeout(LINGER, told).await {
                return;
            }
            end(&device).await;
        });
        self.0.insert(tag, Lingering { fate, task });
    }

    /// Before a task on a tag: its lingering link is kept, or if it is ending already, its end is
    /// waited for. Those of other tags end now, because adapters have few links.
    pub async fn before_use(&mut self, tag: TagAddress) {
        self.0.retain(|_, lingering| !lingering.task.is_finished());
        for (other, lingering) in std::mem::take(&mut self.0) {
            if other == tag {
                // Not heard any more if the end began.
                let _ = lingering.fate.send(Fate::Keep);
                let _ = lingering.task.await;
            } else {
                let _ = lingering.fate.send(Fate::EndNow);
            }
        }
    }

    /// Ends all, and waits for it.
    pub async fn end_all(&mut self) {
        for (_, lingering) in std::mem::take(&mut self.0) {
            let _ = lingering.fate.send(Fate::EndNow);
            let _ = lingering.task.await;
        }
    }
}

/// Ends a link, or a connection that is only being made, and waits until it is over.
pub(super) async fn end(device: &Device) {
    let end = async {
        if device.disconnect().await.is_err() {
            return;
        }
        while device.is_connected().await.unwrap_or(false) {
            sleep(Duration::from_millis(20)).await;
        }
    };
    // What is not over by then is found out by the next task.
    let _ = timeout(END, end).await;
}
