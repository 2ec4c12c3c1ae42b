//! The kernel's video interface (`linux/videodev2.h`) as far as a camera driver needs it: one safe
//! function for each request, typed structures in, typed structures out.
//!
//! The only `unsafe` code of this crate. What it relies on: the structures below have the layout of
//! the kernel's on 64-bit machines (their sizes are part of the request numbers, and are checked at
//! compile time), and a mapped buffer is only read while it is dequeued, because only then does the
//! kernel not write into it.
#![allow(unsafe_code)]

use std::ffi::c_void;
use std::fs::File;
use std::os::fd::AsFd;
use std::path::Path;
use std::ptr::NonNull;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::OFlags;
use rustix::io::{Errno, Result};
use rustix::ioctl::{Opcode, Setter, Updater, ioctl, opcode};
use rustix::mm::{MapFlags, ProtFlags, mmap, munmap};

/// `V4L2_BUF_TYPE_VIDEO_CAPTURE`.
const CAPTURE: u32 = 1;
/// `V4L2_MEMORY_MMAP`.
const MMAP: u32 = 1;

/// `V4L2_CAP_VIDEO_CAPTURE`.
pub const CAP_CAPTURE: u32 = 0x1;
/// `V4L2_CAP_VIDEO_CAPTURE_MPLANE`.
pub const CAP_CAPTURE_MULTIPLANAR: u32 = 0x1000;
/// `V4L2_CAP_STREAMING`.
pub const CAP_STREAMING: u32 = 0x0400_0000;
const CAP_DEVICE_CAPS: u32 = 0x8000_0000;

/// `V4L2_BUF_FLAG_ERROR`: the data may be damaged.
pub const FLAG_ERROR: u32 = 0x40;
/// Mask and value of `V4L2_BUF_FLAG_TIMESTAMP_*`: the stamp is of `CLOCK_MONOTONIC`.
pub const TIMESTAMP_MASK: u32 = 0xE000;
/// See [`TIMESTAMP_MASK`].
pub const TIMESTAMP_MONOTONIC: u32 = 0x2000;
/// Mask and value of `V4L2_BUF_FLAG_TSTAMP_SRC_*`: the stamp is of the start of exposure, else of
/// the frame's end.
pub const STAMP_SOURCE_MASK: u32 = 0x7_0000;
/// See [`STAMP_SOURCE_MASK`].
pub const STAMP_START_OF_EXPOSURE: u32 = 0x1_0000;

/// `V4L2_FIELD_NONE`: progressive pictures.
pub const FIELD_NONE: u32 = 1;

/// `V4L2_CTRL_FLAG_DISABLED`.
const CONTROL_DISABLED: u32 = 1;

#[repr(C)]
#[derive(Clone, Copy)]
struct Capability {
    driver: [u8; 16],
    card: [u8; 32],
    bus_info: [u8; 32],
    version: u32,
    capabilities: u32,
    device_caps: u32,
    reserved: [u32; 3],
}

#[repr(C)]
#[derive(Clone, Copy)]
struct FormatDescription {
    index: u32,
    kind: u32,
    flags: u32,
    description: [u8; 32],
    pixel_format: u32,
    mbus_code: u32,
    reserved: [u32; 3],
}

/// `struct v4l2_pix_format`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PixelLayout {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Four character code.
    pub pixel_format: u32,
    /// Interlacing.
    pub field: u32,
    /// Bytes from one row to the next.
    pub bytes_per_line: u32,
    /// Bytes of a picture at most.
    pub size: u32,
    colorspace: u32,
    private: u32,
    flags: u32,
    encoding: u32,
    quantization: u32,
    transfer: u32,
}

impl PixelLayout {
    /// Progressive pictures of this size and format; the rest as the device likes it.
    pub fn wanted(width: u32, height: u32, pixel_format: u32) -> Self {
        PixelLayout { width, height, pixel_format, field: FIELD_NONE, ..Self::default() }
    }
}

#[repr(C, align(8))]
#[derive(Clone, Copy)]
struct Format {
    kind: u32,
    // The kernel's union holds pointers and so is aligned to eight bytes.
    padding: u32,
    pixels: PixelLayout,
    rest: [u8; 200 - size_of::<PixelLayout>()],
}

#[repr(C)]
#[derive(Clone, Copy, Default)]
struct RequestBuffers {
    count: u32,
    kind: u32,
    memory: u32,
    capabilities: u32,
    flags: u32,
}

#[repr(C)]
#[derive(Clone, Copy, Default)]
struct Buffer {
    index: u32,
    kind: u32,
    bytes_used: u32,
    flags: u32,
    field: u32,
    seconds: i64,
    microseconds: i64,
    timecode: [u32; 4],
    sequence: u32,
    memory: u32,
    offset: u64,
    length: u32,
    reserved: u32,
    request: u32,
}

#[repr(C)]
#[derive(Clone, Copy)]
struct StreamParameters {
    kind: u32,
    capability: u32,
    mode: u32,
    /// Time of a frame (s): numerator and denominator.
    time_per_frame: [u32; 2],
    rest: [u32; 46],
}

#[repr(C)]
#[derive(Clone, Copy, Default)]
struct Control {
    id: u32,
    value: i32,
}

#[repr(C)]
#[derive(Clone, Copy, Default)]
struct ControlQuery {
    id: u32,
    kind: u32,
    name: [u8; 32],
    minimum: i32,
    maximum: i32,
    step: i32,
    default: i32,
    flags: u32,
    reserved: [u32; 2],
}

const QUERYCAP: Opcode = opcode::read::<Capability>(b'V', 0);
const ENUM_FMT: Opcode = opcode::read_write::<FormatDescription>(b'V', 2);
const G_FMT: Opcode = opcode::read_write::<Format>(b'V', 4);
const S_FMT: Opcode = opcode::read_write::<Format>(b'V', 5);
const REQBUFS: Opcode = opcode::read_write::<RequestBuffers>(b'V', 8);
const QUERYBUF: Opcode = opcode::read_write::<Buffer>(b'V', 9);
const QBUF: Opcode = opcode::read_write::<Buffer>(b'V', 15);
const DQBUF: Opcode = opcode::read_write::<Buffer>(b'V', 17);
const STREAMON: Opcode = opcode::write::<u32>(b'V', 18);
const STREAMOFF: Opcode = opcode::write::<u32>(b'V', 19);
const G_PARM: Opcode = opcode::read_write::<StreamParameters>(b'V', 21);
const S_PARM: Opcode = opcode::read_write::<StreamParameters>(b'V', 22);
const G_CTRL: Opcode = opcode::read_write::<Control>(b'V', 27);
const S_CTRL: Opcode = opcode::read_write::<Control>(b'V', 28);
const QUERYCTRL: Opcode = opcode::read_write::<ControlQuery>(b'V', 36);

// The numbers that the kernel's header comes to on x86-64 and arm64; a wrong layout changes them.
const _: () = {
    assert!(QUERYCAP == 0x8068_5600);
    assert!(ENUM_FMT == 0xC040_5602);
    assert!(S_FMT == 0xC0D0_5605);
    assert!(REQBUFS == 0xC014_5608);
    assert!(QUERYBUF == 0xC058_5609);
    assert!(DQBUF == 0xC058_5611);
    assert!(STREAMON == 0x4004_5612);
    assert!(S_PARM == 0xC0CC_5616);
    assert!(S_CTRL == 0xC008_561C);
    assert!(QUERYCTRL == 0xC044_5624);
};

/// An open video device.
pub struct Device(File);

/// What a device is.
pub struct Identity {
    /// Name of the device, as its maker calls it.
    pub card: String,
    /// What this node can do: `CAP_*`.
    pub capabilities: u32,
}

/// Range and step of a control.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ControlRange {
    /// Least value.
    pub minimum: i32,
    /// Greatest value.
    pub maximum: i32,
    /// Step between values.
    pub step: i32,
}

/// A filled buffer.
#[derive(Debug, Clone, Copy)]
pub struct Filled {
    /// Which of the mapped buffers.
    pub index: u32,
    /// How much of it is filled.
    pub bytes_used: u32,
    /// `FLAG_*`, `TIMESTAMP_*`, `STAMP_*`.
    pub flags: u32,
    /// The kernel's stamp.
    pub stamp: Duration,
    /// Number of the frame since the stream began.
    pub sequence: u32,
}

impl Device {
    /// Opens a device node; no call on it blocks afterwards.
    pub fn open(path: &Path) -> std::io::Result<Self> {
        use std::os::unix::fs::OpenOptionsExt;
        let flags = OFlags::NONBLOCK.bits() as i32;
        File::options().read(true).write(true).custom_flags(flags).open(path).map(Device)
    }

    /// # Safety
    /// `REQUEST` reads and writes a `T`, and holds no pointer that outlives the call.
    unsafe fn update<const REQUEST: Opcode, T>(&self, value: &mut T) -> Result<()> {
        loop {
            // SAFETY: promised by the caller.
            match unsafe { ioctl(&self.0, Updater::<REQUEST, T>::new(value)) } {
                Err(Errno::INTR) => {}
                outcome => return outcome,
            }
        }
    }

    /// Name and abilities.
    pub fn identity(&self) -> Result<Identity> {
        let mut capability = Capability {
            driver: [0; 16],
            card: [0; 32],
            bus_info: [0; 32],
            version: 0,
            capabilities: 0,
            device_caps: 0,
            reserved: [0; 3],
        };
        // SAFETY: QUERYCAP fills a Capability.
        unsafe { self.update::<QUERYCAP, _>(&mut capability)? };
        let card = capability.card.split(|b| *b == 0).next().unwrap_or_default();
        // A device has several nodes; this one's abilities are told apart from all.
        let per_node = capability.capabilities & CAP_DEVICE_CAPS != 0;
        Ok(Identity {
            card: String::from_utf8_lossy(card).into_owned(),
            capabilities: match per_node {
                true => capability.device_caps,
                false => capability.capabilities,
            },
        })
    }

    /// The device's pixel formats, in its order of preference.
    pub fn formats(&self) -> Result<Vec<u32>> {
        let mut formats = Vec::new();
        // No device has that many; one that does not stop counting must not keep us.
        for index in 0..256 {
            let mut description = FormatDescription {
                index,
                kind: CAPTURE,
                flags: 0,
                description: [0; 32],
                pixel_format: 0,
                mbus_code: 0,
                reserved: [0; 3],
            };
            // SAFETY: ENUM_FMT updates a FormatDescription.
            match unsafe { self.update::<ENUM_FMT, _>(&mut description) } {
                Ok(()) => formats.push(description.pixel_format),
                Err(Errno::INVAL) => break,
                Err(error) => return Err(error),
            }
        }
        Ok(formats)
    }

    /// The layout in force.
    pub fn layout(&self) -> Result<PixelLayout> {
        let mut format = Format {
            kind: CAPTURE,
            padding: 0,
            pixels: PixelLayout::default(),
            rest: [0; 200 - size_of::<PixelLayout>()],
        };
        // SAFETY: G_FMT updates a Format.
        unsafe { self.update::<G_FMT, _>(&mut format)? };
        Ok(format.pixels)
    }

    /// Asks for a layout; the answer is what the device made of it.
    pub fn set_layout(&self, pixels: PixelLayout) -> Result<PixelLayout> {
        let rest = [0; 200 - size_of::<PixelLayout>()];
        let mut format = Format { kind: CAPTURE, padding: 0, pixels, rest };
        // SAFETY: S_FMT updates a Format.
        unsafe { self.update::<S_FMT, _>(&mut format)? };
        Ok(format.pixels)
    }

    /// Asks for a time per frame (s) as a fraction; the answer is what the device made of it.
    pub fn set_time_per_frame(&self, time: [u32; 2]) -> Result<[u32; 2]> {
        let mut parameters = StreamParameters {
            kind: CAPTURE,
            capability: 0,
            mode: 0,
            time_per_frame: [0; 2],
            rest: [0; 46],
        };
        // SAFETY: G_PARM and S_PARM update StreamParameters.
        unsafe { self.update::<G_PARM, _>(&mut parameters)? };
        parameters.time_per_frame = time;
        // SAFETY: see above.
        unsafe { self.update::<S_PARM, _>(&mut parameters)? };
        Ok(parameters.time_per_frame)
    }

    /// A control's range; `None` when the device does not have it.
    pub fn control_range(&self, id: u32) -> Result<Option<ControlRange>> {
        let mut query = ControlQuery { id, ..ControlQuery::default() };
        // SAFETY: QUERYCTRL updates a ControlQuery.
        match unsafe { self.update::<QUERYCTRL, _>(&mut query) } {
            Ok(()) if query.flags & CONTROL_DISABLED != 0 => Ok(None),
            Ok(()) => Ok(Some(ControlRange {
                minimum: query.minimum,
                maximum: query.maximum,
                step: query.step,
            })),
            // Devices without any control do not know the request.
            Err(Errno::INVAL | Errno::NOTTY) => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// A control's value.
    pub fn control(&self, id: u32) -> Result<i32> {
        let mut control = Control { id, value: 0 };
        // SAFETY: G_CTRL updates a Control.
        unsafe { self.update::<G_CTRL, _>(&mut control)? };
        Ok(control.value)
    }

    /// Sets a control.
    pub fn set_control(&self, id: u32, value: i32) -> Result<()> {
        let mut control = Control { id, value };
        // SAFETY: S_CTRL updates a Control.
        unsafe { self.update::<S_CTRL, _>(&mut control) }
    }

    /// Makes about this many buffers, maps them and hands them to the device.
    pub fn map_buffers(&self, count: u32) -> Result<Vec<Mapping>> {
        let mut request =
            RequestBuffers { count, kind: CAPTURE, memory: MMAP, ..RequestBuffers::default() };
        // SAFETY: REQBUFS updates RequestBuffers.
        unsafe { self.update::<REQBUFS, _>(&mut request)? };
        let mut mappings = Vec::new();
        for index in 0..request.count {
            let mut buffer = Buffer { index, kind: CAPTURE, memory: MMAP, ..Buffer::default() };
            // SAFETY: QUERYBUF updates a Buffer.
            unsafe { self.update::<QUERYBUF, _>(&mut buffer)? };
            // The union's first four bytes are the offset.
            mappings.push(Mapping::new(&self.0, buffer.length, buffer.offset & 0xFFFF_FFFF)?);
            self.queue(index)?;
        }
        Ok(mappings)
    }

    /// Hands a buffer to the device.
    pub fn queue(&self, index: u32) -> Result<()> {
        let mut buffer = Buffer { index, kind: CAPTURE, memory: MMAP, ..Buffer::default() };
        // SAFETY: QBUF updates a Buffer; with this kind of memory the pointer in it is not used.
        unsafe { self.update::<QBUF, _>(&mut buffer) }
    }

    /// Starts the stream.
    pub fn start(&self) -> Result<()> {
        // SAFETY: STREAMON reads one 32-bit number.
        unsafe { ioctl(&self.0, Setter::<STREAMON, u32>::new(CAPTURE)) }
    }

    /// Stops the stream and takes all buffers back, filled or not.
    pub fn stop(&self) -> Result<()> {
        // SAFETY: STREAMOFF reads one 32-bit number.
        unsafe { ioctl(&self.0, Setter::<STREAMOFF, u32>::new(CAPTURE)) }
    }

    /// Waits until a buffer may be filled, or the device has something worse to tell; false when
    /// nothing happened in time.
    pub fn wait(&self, timeout: Duration) -> Result<bool> {
        let mut wanted = [PollFd::from_borrowed_fd(self.0.as_fd(), PollFlags::IN)];
        let timeout = Timespec::try_from(timeout).map_err(|_| Errno::INVAL)?;
        match poll(&mut wanted, Some(&timeout)) {
            Ok(ready) => Ok(ready > 0),
            Err(Errno::INTR) => Ok(false),
            Err(error) => Err(error),
        }
    }

    /// Takes a filled buffer back, if there is one.
    pub fn dequeue(&self) -> Result<Option<Filled>> {
        let mut buffer = Buffer { kind: CAPTURE, memory: MMAP, ..Buffer::default() };
        // SAFETY: DQBUF updates a Buffer; with this kind of memory the pointer in it is not used.
        match unsafe { self.update::<DQBUF, _>(&mut buffer) } {
            Ok(()) => {}
            Err(Errno::AGAIN) => return Ok(None),
            Err(error) => return Err(error),
        }
        let seconds = Duration::from_secs(buffer.seconds.try_into().unwrap_or(0));
        let microseconds = Duration::from_micros(buffer.microseconds.try_into().unwrap_or(0));
        Ok(Some(Filled {
            index: buffer.index,
            bytes_used: buffer.bytes_used,
            flags: buffer.flags,
            stamp: seconds.saturating_add(microseconds),
            sequence: buffer.sequence,
        }))
    }
}

/// A buffer of the device in our memory.
pub struct Mapping {
    start: NonNull<c_void>,
    length: usize,
}

// SAFETY: memory of the process, bound to no thread.
unsafe impl Send for Mapping {}

impl Mapping {
    fn new(file: &File, length: u32, offset: u64) -> Result<Self> {
        let length = length as usize;
        // SAFETY: a new mapping at an address of the kernel's choice touches no other memory.
        let start = unsafe {
            mmap(std::ptr::null_mut(), length, ProtFlags::READ, MapFlags::SHARED, file, offset)?
        };
        let start = NonNull::new(start).ok_or(Errno::NOMEM)?;
        Ok(Mapping { start, length })
    }

    /// A copy of the first bytes, to be taken while the buffer is dequeued.
    pub fn copy(&self, length: usize) -> Vec<u8> {
        let length = length.min(self.length);
        // SAFETY: the mapping has at least `length` readable bytes and lives as long as `self`; the
        // device does not write into it while it is dequeued.
        unsafe { std::slice::from_raw_parts(self.start.cast().as_ptr(), length) }.to_vec()
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: this mapping is ours and nothing borrows from it. A failure leaves it mapped.
        let _ = unsafe { munmap(self.start.as_ptr(), self.length) };
    }
}
