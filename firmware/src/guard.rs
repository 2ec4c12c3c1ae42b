//! Keeps malformed packets from the host stack.
//!
//! trouble-host 0.8 trusts the lengths that a peer sends: seven short attribute requests, which any
//! unpaired peer may send, end it in a panic, and so do some answers of a hostile tag on the robot's
//! side. [`Guard`] stands between stack and controller. It puts the fragments of every L2CAP frame
//! together, checks the whole frame ([`well_formed`](crate::frame::well_formed)) and hands it on in
//! one piece, or drops it. The stack then never sees a fragment, a frame of an unknown channel or a
//! list whose end does not lie where it says.
//!
//! A dropped request gets no answer; well-behaved peers do not send such.
//!
//! What a peer sends as soon as it has connected waits until the firmware was told of the link: a tag
//! that is slow for a moment would answer a pairing before it has said that it keeps bonds.

use core::cell::{Cell, RefCell};

use bt_hci::ControllerToHostPacket;
use bt_hci::cmd::{AsyncCmd, Error as CommandError, SyncCmd};
use bt_hci::controller::{Controller, ControllerCmdAsync, ControllerCmdSync};
use bt_hci::data::{AclBroadcastFlag, AclPacket, AclPacketBoundary, IsoPacket, SyncPacket};
use bt_hci::event::{EventKind, EventPacket};
use bt_hci::param::ConnHandle;
use embassy_futures::yield_now;
use embedded_io::ErrorType;

use crate::frame::well_formed;

/// Longest frame with its header: an attribute MTU of 247 (251 bytes fit one modern radio packet).
pub const FRAME: usize = 251;
/// Longest event.
const EVENT: usize = 255;
const NO_LINK: u16 = u16::MAX;
/// Subevents of a completed connection: plain, enhanced, enhanced of version 2 (Core 5.4 Vol 4, Part E,
/// 7.7.65).
const CONNECTED: [u8; 3] = [0x01, 0x0A, 0x29];

/// A frame that is being put together.
struct Partial {
    handle: u16,
    have: usize,
    data: [u8; FRAME],
}

/// A controller whose host is safe from malformed packets on up to `LINKS` links.
pub struct Guard<C, const LINKS: usize> {
    inner: C,
    partial: RefCell<[Partial; LINKS]>,
    dropped: Cell<u32>,
    /// The last event told of a new link.
    connected: Cell<bool>,
}

impl<C, const LINKS: usize> Guard<C, LINKS> {
    /// Stands before a controller.
    pub fn new(inner: C) -> Self {
        const EMPTY: Partial = Partial { handle: NO_LINK, have: 0, data: [0; FRAME] };
        let partial = RefCell::new([EMPTY; LINKS]);
        Guard { inner, partial, dropped: Cell::new(0), connected: Cell::new(false) }
    }

    /// How many frames were dropped so far.
    pub fn dropped(&self) -> u32 {
        self.dropped.get()
    }

    /// Takes a fragment; the length of the frame in `out` when it completes a good one.
    fn collect(&self, packet: &AclPacket<'_>, out: &mut [u8; EVENT]) -> Option<usize> {
        let mut partials = self.partial.borrow_mut();
        let handle = packet.handle().raw();
        let first = packet.boundary_flag() != AclPacketBoundary::Continuing;
        let slot = match partials.iter().position(|p| p.handle == handle) {
            Some(slot) => slot,
            None if first => partials.iter().position(|p| p.handle == NO_LINK)?,
            None => return self.refuse(),
        };
        let partial = &mut partials[slot];
        if first {
            if partial.have > 0 {
                // The frame before was never finished.
                self.dropped.set(self.dropped.get().wrapping_add(1));
            }
            (partial.handle, partial.have) = (handle, 0);
        } else if partial.have == 0 {
            return self.refuse();
        }
        let data = packet.data();
        let Some(space) = partial.data.get_mut(partial.have..partial.have + data.len()) else {
            partial.have = 0;
            return self.refuse();
        };
        space.copy_from_slice(data);
        partial.have += data.len();
        if partial.have == 0 {
            return self.refuse();
        }
        let [low, high, channel_low, channel_high, ..] = partial.data;
        let whole = 4 + usize::from(u16::from_le_bytes([low, high]));
        if partial.have < 4 || partial.have < whole {
            return None;
        }
        let length = core::mem::take(&mut partial.have);
        let channel = u16::from_le_bytes([channel_low, channel_high]);
        let good = length == whole && well_formed(channel, &mut partial.data[4..length]);
        if !good {
            return self.refuse();
        }
        out[..length].copy_from_slice(&partial.data[..length]);
        Some(length)
    }

    fn refuse(&self) -> Option<usize> {
        self.dropped.set(self.dropped.get().wrapping_add(1));
        None
    }

    /// Notes a new link.
    fn note(&self, event: &EventPacket<'_>) {
        let subevent = event.data.first().is_some_and(|code| CONNECTED.contains(code));
        self.connected.set(event.kind == EventKind::Le && subevent);
    }

    /// Forgets what a link that ended had left unfinished.
    fn forget(&self, event: &EventPacket<'_>) {
        let [_, low, high, ..] = event.data else { return };
        if event.kind != EventKind::DisconnectionComplete {
            return;
        }
        let handle = u16::from_le_bytes([*low, *high]) & 0x0FFF;
        let mut partials = self.partial.borrow_mut();
        for partial in partials.iter_mut().filter(|p| p.handle == handle) {
            (partial.handle, partial.have) = (NO_LINK, 0);
        }
    }
}

/// Buffer of a guarded controller: what it reads, and what it hands on.
pub struct Buffer<B> {
    inner: B,
    out: [u8; EVENT],
}

/// What a guarded read found; its bytes are in the buffer's second half.
enum Found {
    Frame(ConnHandle, usize),
    Event(EventKind, usize),
}

impl<C: ErrorType, const LINKS: usize> ErrorType for Guard<C, LINKS> {
    type Error = C::Error;
}

impl<C: Controller, const LINKS: usize> Controller for Guard<C, LINKS> {
    type Buffer<'a> = Buffer<C::Buffer<'a>>;

    fn alloc_buf(&self) -> Result<Self::Buffer<'_>, Self::Error> {
        Ok(Buffer { inner: self.inner.alloc_buf()?, out: [0; EVENT] })
    }

    async fn write_acl_data(&self, packet: &AclPacket<'_>) -> Result<(), Self::Error> {
        self.inner.write_acl_data(packet).await
    }

    async fn write_sync_data(&self, packet: &SyncPacket<'_>) -> Result<(), Self::Error> {
        self.inner.write_sync_data(packet).await
    }

    async fn write_iso_data(&self, packet: &IsoPacket<'_>) -> Result<(), Self::Error> {
        self.inner.write_iso_data(packet).await
    }

    async fn read<'a>(
        &self,
        buf: &'a mut Self::Buffer<'_>,
    ) -> Result<ControllerToHostPacket<'a>, Self::Error> {
        if self.connected.take() {
            yield_now().await;
        }
        let found = loop {
            match self.inner.read(&mut buf.inner).await? {
                ControllerToHostPacket::Acl(packet) => {
                    if let Some(length) = self.collect(&packet, &mut buf.out) {
                        break Found::Frame(packet.handle(), length);
                    }
                }
                ControllerToHostPacket::Event(event) => {
                    self.forget(&event);
                    self.note(&event);
                    let length = event.data.len().min(EVENT);
                    buf.out[..length].copy_from_slice(&event.data[..length]);
                    break Found::Event(event.kind, length);
                }
                // Voice and isochronous channels are not used.
                ControllerToHostPacket::Sync(_) | ControllerToHostPacket::Iso(_) => {}
            }
        };
        Ok(match found {
            Found::Frame(handle, length) => ControllerToHostPacket::Acl(AclPacket::new(
                handle,
                AclPacketBoundary::FirstFlushable,
                AclBroadcastFlag::PointToPoint,
                &buf.out[..length],
            )),
            Found::Event(kind, length) => {
                ControllerToHostPacket::Event(EventPacket { kind, data: &buf.out[..length] })
            }
        })
    }
}

impl<Q: SyncCmd, C: ControllerCmdSync<Q>, const LINKS: usize> ControllerCmdSync<Q>
    for Guard<C, LINKS>
{
    async fn exec(&self, command: &Q) -> Result<Q::Return, CommandError<Self::Error>> {
        self.inner.exec(command).await
    }
}

impl<Q: AsyncCmd, C: ControllerCmdAsync<Q>, const LINKS: usize> ControllerCmdAsync<Q>
    for Guard<C, LINKS>
{
    async fn exec(&self, command: &Q) -> Result<(), CommandError<Self::Error>> {
        self.inner.exec(command).await
    }
}

#[cfg(test)]
mod tests {
    use core::pin::pin;
    use core::task::{Context, Waker};

    use super::*;

    fn feed(guard: &Guard<(), 2>, handle: u16, first: bool, data: &[u8]) -> Option<usize> {
        let boundary = match first {
            true => AclPacketBoundary::FirstFlushable,
            false => AclPacketBoundary::Continuing,
        };
        let flags = AclBroadcastFlag::PointToPoint;
        let packet = AclPacket::new(ConnHandle::new(handle), boundary, flags, data);
        guard.collect(&packet, &mut [0; EVENT])
    }

    #[test]
    fn fragments_become_frames() {
        let guard = Guard::new(());
        assert_eq!(feed(&guard, 1, true, &[3, 0, 4]), None);
        assert_eq!(feed(&guard, 2, true, &[3, 0, 4, 0, 0x0A, 1, 0]), Some(7), "another link");
        assert_eq!(feed(&guard, 1, false, &[0, 0x0A, 1]), None);
        assert_eq!(feed(&guard, 1, false, &[0]), Some(7));
        assert_eq!(guard.dropped(), 0);
    }

    #[test]
    fn what_does_not_fit_is_dropped() {
        let guard = Guard::new(());
        assert_eq!(feed(&guard, 1, false, &[0]), None, "continues nothing");
        assert_eq!(feed(&guard, 1, true, &[3, 0, 4, 0, 0x0A, 1, 0, 9]), None, "too long");
        assert_eq!(feed(&guard, 1, true, &[0, 0, 4, 0]), None, "empty request");
        assert_eq!(feed(&guard, 1, true, &[0xFF, 0xFF, 4, 0]), None);
        assert_eq!(feed(&guard, 1, false, &[0; 248]), None, "longer than any frame");
        assert_eq!(guard.dropped(), 4);
        assert_eq!(feed(&guard, 1, true, &[3, 0, 4, 0, 0x0A, 1, 0]), Some(7), "and recovers");
    }

    /// Has everything ready at once: event after event of completed connections.
    struct Busy;

    impl ErrorType for Busy {
        type Error = core::convert::Infallible;
    }

    impl Controller for Busy {
        type Buffer<'a> = [u8; 0];

        fn alloc_buf(&self) -> Result<[u8; 0], Self::Error> {
            Ok([])
        }
        async fn write_acl_data(&self, _: &AclPacket<'_>) -> Result<(), Self::Error> {
            Ok(())
        }
        async fn write_sync_data(&self, _: &SyncPacket<'_>) -> Result<(), Self::Error> {
            Ok(())
        }
        async fn write_iso_data(&self, _: &IsoPacket<'_>) -> Result<(), Self::Error> {
            Ok(())
        }
        async fn read<'a>(
            &self,
            _: &'a mut Self::Buffer<'_>,
        ) -> Result<ControllerToHostPacket<'a>, Self::Error> {
            Ok(ControllerToHostPacket::Event(EventPacket { kind: EventKind::Le, data: &[0x01] }))
        }
    }

    #[test]
    fn the_firmware_hears_of_a_link_before_what_comes_over_it() {
        let guard = Guard::<Busy, 1>::new(Busy);
        let Ok(mut buffer) = guard.alloc_buf();
        let mut context = Context::from_waker(Waker::noop());
        assert!(pin!(guard.read(&mut buffer)).poll(&mut context).is_ready(), "of the link");
        let mut next = pin!(guard.read(&mut buffer));
        assert!(next.as_mut().poll(&mut context).is_pending(), "the firmware's turn");
        assert!(next.poll(&mut context).is_ready(), "and then the rest");
    }
}
