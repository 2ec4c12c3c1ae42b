//! Packet memory of the stacks on a host computer: the heap.
//!
//! trouble-host's own pool is one static array that all stacks of a process would share, so that a
//! flood on one link starved the others.

use trouble_host::{Packet, PacketPool};

/// Longest packet: what one radio packet of 251 bytes carries.
pub const PACKET: usize = 251;

/// Packets on the heap.
pub enum HeapPool {}

/// One packet.
pub struct HeapPacket(Box<[u8; PACKET]>);

impl AsRef<[u8]> for HeapPacket {
    fn as_ref(&self) -> &[u8] {
        &self.0[..]
    }
}

impl AsMut<[u8]> for HeapPacket {
    fn as_mut(&mut self) -> &mut [u8] {
        &mut self.0[..]
    }
}

impl Packet for HeapPacket {}

impl PacketPool for HeapPool {
    type Packet = HeapPacket;

    const MTU: usize = PACKET;

    fn allocate() -> Option<HeapPacket> {
        Some(HeapPacket(Box::new([0; PACKET])))
    }

    fn capacity() -> usize {
        // The stack's queues bound what is in use; this many is never reached.
        usize::from(u16::MAX)
    }
}
