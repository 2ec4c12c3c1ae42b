//! A Bluetooth controller of this computer without the kernel's own host: the HCI user channel.
//!
//! In: the controller's number (0 is `hci0`). Out: an H4 stream to it. The kernel hands the controller
//! over whole (`man 7 bluetooth`, `HCI_CHANNEL_USER`): it must be powered off, bluetoothd must leave it
//! alone, and the caller needs CAP_NET_ADMIN. When the stream is closed, the kernel resets it.
#![allow(unsafe_code)] // Two system calls that the standard library does not have.

use std::fs::File;
use std::io::{self, BufReader, Read};
use std::mem::size_of;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};

use libc::{AF_BLUETOOTH, SOCK_CLOEXEC, SOCK_RAW};

const BTPROTO_HCI: libc::c_int = 1;
const HCI_CHANNEL_USER: u16 = 1;
/// Longer than any HCI packet.
const LONGEST_PACKET: usize = 8192;

/// `struct sockaddr_hci` of the kernel.
#[repr(C)]
struct Address {
    family: u16,
    device: u16,
    channel: u16,
}

/// Takes a controller over. Reads one packet after the other, writes one packet a call.
pub(crate) fn open(controller: u16) -> io::Result<(impl Read + Send + 'static, File)> {
    // SAFETY: a plain system call; its result is checked before it is taken for a descriptor.
    let socket = unsafe { libc::socket(AF_BLUETOOTH, SOCK_RAW | SOCK_CLOEXEC, BTPROTO_HCI) };
    if socket < 0 {
        return Err(io::Error::last_os_error());
    }
    // SAFETY: the descriptor is new, open, and nobody else's.
    let socket = unsafe { OwnedFd::from_raw_fd(socket) };
    let address =
        Address { family: AF_BLUETOOTH as u16, device: controller, channel: HCI_CHANNEL_USER };
    // SAFETY: the kernel reads as many bytes of the address as it is told, and these are there.
    let bound = unsafe {
        libc::bind(
            socket.as_raw_fd(),
            (&raw const address).cast(),
            size_of::<Address>() as libc::socklen_t,
        )
    };
    if bound < 0 {
        return Err(io::Error::last_os_error());
    }
    let writer = File::from(socket);
    // Every read of the socket takes a whole packet and drops what does not fit.
    let reader = BufReader::with_capacity(LONGEST_PACKET, writer.try_clone()?);
    Ok((reader, writer))
}
