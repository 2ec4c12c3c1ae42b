//! The robot's Bluetooth host: one task that carries out jobs, one after the other.
//!
//! A link is made for a job and ended after it, but for a tag whose light plays: its link is held,
//! because a tag goes dark when its robot is gone. Jobs whose link breaks are tried again until their
//! time is up.

use std::cell::RefCell;
use std::time::Duration;

use bt_hci::cmd::le::LeSetScanParams;
use bt_hci::controller::ControllerCmdSync;
use embassy_futures::select::{Either, select};
use embassy_time::{Timer, with_timeout};
use trouble_host::connection::{
    ConnectConfig, Connection, ConnectionEvent, RequestedConnParams, ScanConfig, SecurityLevel,
};
use trouble_host::prelude::{AddrKind, BdAddr};
use trouble_host::scan::Scanner;
use trouble_host::{Address, BondInformation, Controller, HostResources, IoCapabilities, Stack};
use vergence_devices::TagAddress;
use vergence_firmware::Guard;
use vergence_firmware::store::{decode_bond, encode_bond};
use vergence_tag::Command;

use crate::conversation::{self, KnownHandles};
use crate::ears::Ears;
use crate::job::{self, Answer, Bond, Fault, Inbox, Job, Outcome, Task};
use crate::pool::HeapPool;

/// Links at once: the tag that is being asked, and those that blink.
pub(crate) const LINKS: usize = 8;
const BONDS: usize = 64;

/// How the robot uses its radio.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LinkConfig {
    /// Static random address of the robot, most significant byte first; the two top bits are set.
    pub address: [u8; 6],
    /// Connection interval: a request and its answer take two. 15 ms is what phones allow at best
    /// and reads a record in half of the time that 30 ms takes.
    pub interval: Duration,
    /// A link on which nothing was heard for this long is lost.
    pub supervision_timeout: Duration,
}

impl Default for LinkConfig {
    fn default() -> Self {
        LinkConfig {
            address: [0xC0, 0x56, 0x45, 0x52, 0x47, 0x01],
            interval: Duration::from_millis(15),
            supervision_timeout: Duration::from_secs(2),
        }
    }
}

pub(crate) type Host<'s, C> = Stack<'s, Guard<C, LINKS>, HeapPool>;

struct Held<'a> {
    tag: TagAddress,
    connection: Connection<'a, HeapPool>,
}

struct Central<'a, 's, C: Controller> {
    stack: &'a Host<'s, C>,
    config: LinkConfig,
    ears: &'a Ears,
    held: RefCell<Vec<Held<'a>>>,
    handles: KnownHandles,
}

/// Runs the host on a controller until the inbox is closed or the controller fails.
pub(crate) async fn run<C>(controller: C, config: LinkConfig, inbox: Inbox)
where
    C: Controller + ControllerCmdSync<LeSetScanParams>,
{
    let mut resources: HostResources<HeapPool, LINKS, 2, 1, BONDS> = HostResources::new();
    let mut address = config.address;
    address.reverse();
    let stack: Host<'_, C> = trouble_host::new(Guard::new(controller), &mut resources)
        .set_random_address(Address::random(address))
        .set_io_capabilities(IoCapabilities::NoInputNoOutput)
        .build();
    let ears = Ears::default();
    let central = Central {
        stack: &stack,
        config,
        ears: &ears,
        held: RefCell::default(),
        handles: KnownHandles::default(),
    };
    let mut runner = stack.runner();
    let work = async {
        while let Some((job, reply)) = inbox.next().await {
            // A caller that no longer waits does not want the outcome.
            let _ = reply.send(central.execute(job).await);
        }
    };
    let reason = match select(runner.run_with_handler(&ears), work).await {
        Either::First(Ok(())) => "the host stack ended".to_owned(),
        Either::First(Err(error)) => format!("controller: {}", job::describe(&error)),
        Either::Second(()) => return,
    };
    // Whoever asks from now on is told why there is no answer.
    while let Some((_, reply)) = inbox.next().await {
        let _ = reply.send(Err(Fault::Dead(reason.clone())));
    }
}

fn ticks(time: Duration) -> embassy_time::Duration {
    embassy_time::Duration::from_micros(time.as_micros() as u64)
}

impl<'a, C: Controller + ControllerCmdSync<LeSetScanParams>> Central<'a, '_, C> {
    async fn execute(&self, job: Job) -> Outcome {
        match job {
            Job::Scan(window) => self.scan(window).await,
            Job::AddBond(Bond(bytes)) => {
                let bond = decode_bond(&bytes);
                let added = bond.map(|bond| self.stack.add_bond_information(bond));
                match added {
                    Some(Ok(())) => Ok(Answer::Done),
                    _ => Err(Fault::Refused("is no bond, or there are too many".into())),
                }
            }
            Job::Attend { tag, task: Task::Release, .. } => {
                let held = self.take_held(tag);
                if let Some(connection) = held {
                    self.close(&connection).await;
                }
                Ok(Answer::Done)
            }
            Job::Attend { tag, task, timeout } => {
                let tries = async {
                    loop {
                        match self.attempt(tag, &task).await {
                            Err(Fault::Lost) => Timer::after_millis(20).await,
                            outcome => return outcome,
                        }
                    }
                };
                with_timeout(ticks(timeout), tries).await.unwrap_or(Err(Fault::Late))
            }
        }
    }

    async fn scan(&self, window: Duration) -> Outcome {
        self.ears.forget();
        let mut central = self.stack.central();
        let config = ScanConfig {
            active: true,
            interval: embassy_time::Duration::from_millis(100),
            window: embassy_time::Duration::from_millis(100),
            ..ScanConfig::default()
        };
        let mut scanner = Scanner::new(&mut central);
        let scan = async {
            let session = scanner.scan(&config).await.map_err(Fault::of)?;
            Timer::after(ticks(window)).await;
            session.stop().await;
            Ok(())
        };
        // The controller's answers must not hold up the robot.
        let bound = ticks(window + Duration::from_secs(2));
        with_timeout(bound, scan).await.unwrap_or(Err(Fault::Late))?;
        Ok(Answer::Heard(self.ears.tags()))
    }

    /// A held link to this tag, if it is still there.
    fn take_held(&self, tag: TagAddress) -> Option<Connection<'a, HeapPool>> {
        let mut held = self.held.borrow_mut();
        held.retain(|h| h.connection.is_connected());
        let index = held.iter().position(|h| h.tag == tag)?;
        Some(held.swap_remove(index).connection)
    }

    async fn connect(&self, tag: TagAddress) -> Result<Connection<'a, HeapPool>, Fault> {
        if let Some(connection) = self.take_held(tag) {
            return Ok(connection);
        }
        if self.held.borrow().len() + 1 >= LINKS {
            let most = LINKS - 1;
            return Err(Fault::Refused(format!("cannot be reached: {most} others are blinking")));
        }
        let mut address = tag.0;
        address.reverse();
        let kind = if self.ears.is_public(tag) { AddrKind::PUBLIC } else { AddrKind::RANDOM };
        let peers = [Address::new(kind, BdAddr::new(address))];
        let interval = ticks(self.config.interval);
        let config = ConnectConfig {
            scan_config: ScanConfig {
                filter_accept_list: &peers,
                interval: embassy_time::Duration::from_millis(30),
                window: embassy_time::Duration::from_millis(30),
                ..ScanConfig::default()
            },
            connect_params: RequestedConnParams {
                min_connection_interval: interval,
                max_connection_interval: interval,
                max_latency: 0,
                min_event_length: embassy_time::Duration::from_ticks(0),
                max_event_length: embassy_time::Duration::from_ticks(0),
                supervision_timeout: ticks(self.config.supervision_timeout),
            },
        };
        self.stack.central().connect(&config).await.map_err(Fault::of)
    }

    /// Ends a link and waits until the tag knows, or can be taken to be gone.
    async fn close(&self, connection: &Connection<'a, HeapPool>) {
        connection.disconnect();
        let gone = async {
            loop {
                if let ConnectionEvent::Disconnected { .. } = connection.next().await {
                    return;
                }
            }
        };
        let _ = with_timeout(ticks(self.config.interval * 10), gone).await;
    }

    /// One try of a task.
    async fn attempt(&self, tag: TagAddress, task: &Task) -> Outcome {
        let connection = self.connect(tag).await?;
        if let Task::Pair(passkey) = task {
            let mut outcome = self.pair(&connection, *passkey).await;
            if outcome.is_ok() {
                // The robot's last key may still be on its way, and the end of the link would overtake
                // it: the tag would have no bond. A request cannot, so that its answer is the proof.
                outcome = match self.hold(&connection, tag, &Task::Info).await {
                    Ok(_) => outcome,
                    // What a tag with a passkey does to those that paired without.
                    Err(Fault::Lost) if passkey.is_none() => Err(Fault::Unwanted),
                    Err(fault) => Err(fault),
                };
                if outcome.is_err() {
                    let _ = self.stack.remove_bond_information(connection.peer_identity());
                }
            }
            self.close(&connection).await;
            return outcome;
        }
        let outcome = self.hold(&connection, tag, task).await;
        let plays = matches!(task, Task::Command(Command::Play { .. })) && outcome.is_ok();
        if plays && connection.is_connected() {
            self.held.borrow_mut().push(Held { tag, connection });
        } else {
            self.close(&connection).await;
        }
        outcome
    }

    async fn hold(
        &self,
        connection: &Connection<'a, HeapPool>,
        tag: TagAddress,
        task: &Task,
    ) -> Outcome {
        conversation::hold(self.stack, connection, self.ears, &self.handles, tag, task).await
    }

    async fn pair(&self, connection: &Connection<'a, HeapPool>, passkey: Option<u32>) -> Outcome {
        let io = match passkey {
            Some(_) => IoCapabilities::KeyboardOnly,
            None => IoCapabilities::NoInputNoOutput,
        };
        self.stack.set_io_capabilities(io);
        connection.set_bondable(true).map_err(|_| Fault::Lost)?;
        if connection.is_bonded_peer() {
            // An old bond would be used in place of a new pairing.
            let _ = self.stack.remove_bond_information(connection.peer_identity());
        }
        connection.request_security().map_err(|_| Fault::Lost)?;
        loop {
            match connection.next().await {
                ConnectionEvent::PassKeyInput => {
                    connection.pass_key_input(passkey.unwrap_or(0)).map_err(|_| Fault::Lost)?;
                }
                ConnectionEvent::PairingComplete { security_level, .. }
                    if passkey.is_some()
                        && security_level != SecurityLevel::EncryptedAuthenticated =>
                {
                    // Whatever answered never asked for the passkey: anybody can do that.
                    let _ = self.stack.remove_bond_information(connection.peer_identity());
                    return Err(Fault::Unproven);
                }
                ConnectionEvent::PairingComplete { bond, .. } => {
                    return Ok(Answer::Paired(
                        bond.map(|b: BondInformation| Bond(encode_bond(&b))),
                    ));
                }
                ConnectionEvent::PairingFailed(reason) => {
                    return Err(Fault::Refused(format!("pairing failed: {reason:?}")));
                }
                // Not tried again: the tag counts failed pairings and answers ever later.
                ConnectionEvent::Disconnected { .. } => {
                    return Err(Fault::Refused("pairing failed: the link ended".into()));
                }
                _ => {}
            }
        }
    }
}
