//! The workcell's devices over the wires of real ones, in real time.
//!
//! In: a workcell and a servo model. Out: four servos on one pseudo-terminal in ROBOTIS' protocol, two
//! cameras as MJPEG over HTTP, tags behind HCI controllers on TCP, and the wiring that a robot's
//! configuration needs to use them ([`WiredWorkcell::wiring`]). Any client may drive them, ours or
//! another's; nothing tells it that no metal moves.
//!
//! The world's clock is the wall's. Each camera has a thread that waits for its frame's end, renders
//! what was exposed and shows it. One that cannot keep up drops frames, those first that were taken while
//! the head turned: they cost the most and nobody needs them. A camera that nobody watches is not
//! rendered.

use std::fmt::Write as _;
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, MutexGuard};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use nalgebra::Point3;
use vergence_devices::Side;
use vergence_devices::dynamixel::model::MODELS;
use vergence_devices::dynamixel::{Model, Shaft, Trouble, VirtualBus, VirtualServo};
use vergence_devices::mjpeg::MjpegServer;
use vergence_imaging::codec;

use crate::camera::{Capture, Sensor};
use crate::workcell::{Truth, Workcell};
use crate::world::{Shared, lock};

/// Quality of pictures when the settings ask for raw ones: compression then adds less than the noise.
const QUALITY: u8 = 95;
const PATHS: [&str; 2] = ["/left", "/right"];
/// Frames that a camera may be late: half a second at 30 a second.
const BACKLOG: usize = 16;
/// Longest sleep of a camera's thread, so that it ends soon when asked to.
const NAP: Duration = Duration::from_millis(50);

/// The servo model whose step is nearest to the one that the simulator's settings ask for.
pub fn fitting_servo(resolution_deg: f64) -> &'static Model {
    let off = |model: &&Model| (model.tick.to_degrees() / resolution_deg).ln().abs();
    MODELS.iter().min_by(|a, b| off(a).total_cmp(&off(b))).unwrap_or(&MODELS[0])
}

/// A workcell behind wires; its devices go when it is dropped.
pub struct WiredWorkcell {
    workcell: Workcell,
    model: &'static Model,
    bus: VirtualBus,
    servo_port: PathBuf,
    cameras: Arc<MjpegServer>,
    tags: SocketAddr,
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl WiredWorkcell {
    /// Offers the devices of a workcell on this machine, on free ports. Its servos should step as the
    /// model does (`[sim.servos] resolution_deg`).
    pub fn start(workcell: Workcell, model: &'static Model) -> io::Result<Self> {
        let free = (IpAddr::V4(Ipv4Addr::LOCALHOST), 0);
        let tag_listener = TcpListener::bind(free)?;
        let tags = tag_listener.local_addr()?;
        let cameras = Arc::new(MjpegServer::start(TcpListener::bind(free)?, &PATHS)?);
        let pace = Pace { world: workcell.world().clone(), start: Instant::now() };
        workcell.serve_tags(tag_listener)?;
        lock(workcell.world()).settings.camera.buffer_frames = BACKLOG;
        let servos = Side::BOTH.into_iter().flat_map(|side| [(side, 0), (side, 1)]);
        let servos = servos.zip(1u8..).map(|((side, joint), id)| {
            VirtualServo::new(id, model, WiredShaft { pace: pace.clone(), side, joint })
        });
        let (bus, servo_port) = VirtualBus::on_pty(servos.collect(), Trouble::default())?;
        let stop = Arc::new(AtomicBool::new(false));
        let quality = match workcell.settings().camera.jpeg_quality {
            0 => QUALITY,
            asked => asked,
        };
        let film = |side: Side| {
            let film = Film {
                pace: pace.clone(),
                side,
                sensor: workcell.sensor(side),
                server: cameras.clone(),
                stop: stop.clone(),
                quality,
            };
            let name = format!("{} camera", side.name());
            std::thread::Builder::new().name(name).spawn(move || film.run())
        };
        let threads = vec![film(Side::Left)?, film(Side::Right)?];
        Ok(WiredWorkcell { workcell, model, bus, servo_port, cameras, tags, stop, threads })
    }

    /// The pseudo-terminal of the servo bus; IDs 1 to 4 are left pan, left tilt, right pan, right tilt.
    pub fn servo_port(&self) -> &Path {
        &self.servo_port
    }

    /// The servos on the bus, to look at or to harm.
    pub fn servos(&self) -> MutexGuard<'_, Vec<VirtualServo>> {
        self.bus.servos()
    }

    /// Address of a camera.
    pub fn camera_url(&self, side: Side) -> String {
        format!("http://{}{}", self.cameras.address(), PATHS[side as usize])
    }

    /// Where Bluetooth controllers in reach of the tags are had.
    pub fn tags(&self) -> SocketAddr {
        self.tags
    }

    /// Holds an object's light at a place (base, m), see [`Workcell::hold_light`].
    pub fn hold_light(&self, id: &str, place: &Point3<f64>) -> bool {
        self.workcell.hold_light(id, place)
    }

    /// What is really so, at this moment.
    pub fn truth(&self) -> Truth {
        self.workcell.truth()
    }

    /// The configuration of a robot with these devices; `robot` is the path of its URDF.
    pub fn wiring(&self, robot: &str) -> String {
        let settings = self.workcell.settings();
        let config = self.workcell.config();
        let mut out =
            String::from("# A simulated workcell over wires, as `vergence sim` offers it.\n");
        // Writing to a string cannot fail.
        let _ = writeln!(out, "robot = {}\n", quoted(robot));
        for side in Side::BOTH {
            let (name, head) = (side.name(), config.head(side));
            let (k, c) = (side as u8, &head.camera);
            let _ = write!(
                out,
                "[{name}]\npan_joint = {}\ntilt_joint = {}\noptical_frame = {}\n\n\
                 [{name}.camera]\ndriver = \"mjpeg\"\nwidth = {}\nheight = {}\nfx = {:?}\nfy = {:?}\n\
                 cx = {:?}\ncy = {:?}\ndistortion = {:?}\nmjpeg = {{ url = {}, exposure = {:?} }}\n\n\
                 [{name}.servos]\ndriver = \"dynamixel\"\n\n[{name}.servos.dynamixel]\nport = {}\n\
                 model = \"{}\"\npan = {{ id = {} }}\ntilt = {{ id = {} }}\nbacklash = {:?}\n\n",
                quoted(&head.pan_joint),
                quoted(&head.tilt_joint),
                quoted(&head.optical_frame),
                c.width,
                c.height,
                c.fx,
                c.fy,
                c.cx,
                c.cy,
                c.distortion,
                quoted(&self.camera_url(side)),
                settings.camera.exposure,
                quoted(&self.servo_port.to_string_lossy()),
                self.model.name,
                2 * k + 1,
                2 * k + 2,
                settings.servos.backlash_deg.to_radians(),
            );
        }
        let _ =
            write!(out, "[radio]\ndriver = \"hci\"\ntcp = {}\n", quoted(&self.tags.to_string()));
        out
    }
}

impl Drop for WiredWorkcell {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            // A panic there has been reported already.
            let _ = thread.join();
        }
    }
}

fn quoted(text: &str) -> String {
    toml::Value::String(text.into()).to_string()
}

/// The wall's clock, to which the world is brought whenever somebody looks.
#[derive(Clone)]
struct Pace {
    world: Shared,
    start: Instant,
}

impl Pace {
    /// Lets everything happen up to now, then does something with the world.
    fn now<T>(&self, work: impl FnOnce(&mut crate::world::World) -> T) -> T {
        let mut world = lock(&self.world);
        world.advance_to(self.start.elapsed());
        work(&mut world)
    }
}

/// One joint of a head as a servo's shaft.
struct WiredShaft {
    pace: Pace,
    side: Side,
    joint: usize,
}

impl Shaft for WiredShaft {
    fn drive(&mut self, goal: f64, speed: f64) {
        self.pace.now(|world| {
            let now = world.seconds();
            world.heads[self.side as usize].servos[self.joint].drive(now, goal, speed);
        });
    }

    fn release(&mut self) {
        self.pace.now(|world| world.heads[self.side as usize].servos[self.joint].release());
    }

    fn encoder(&mut self) -> (f64, bool) {
        self.pace.now(|world| {
            let servo = &world.heads[self.side as usize].servos[self.joint];
            (servo.encoder(), servo.moving())
        })
    }
}

/// One camera's thread.
struct Film {
    pace: Pace,
    side: Side,
    sensor: Sensor,
    server: Arc<MjpegServer>,
    stop: Arc<AtomicBool>,
    quality: u8,
}

impl Film {
    fn run(mut self) {
        let mut next = 0;
        while !self.stop.load(Ordering::Relaxed) {
            let end = Duration::from_secs_f64(lock(&self.pace.world).shutter.end(next));
            let wait = end.saturating_sub(self.pace.start.elapsed());
            if !wait.is_zero() {
                std::thread::sleep(wait.min(NAP));
                continue;
            }
            if !self.server.watched(self.side as usize) {
                next = self.pace.now(|world| world.frame);
                continue;
            }
            let Some(capture) = self.next_capture(next) else {
                // The end and the world's clock may differ by a rounding.
                std::thread::sleep(Duration::from_millis(1));
                continue;
            };
            next = capture.sequence + 1;
            let picture = self.sensor.picture(&capture);
            // Pictures of a positive size can be compressed; one that cannot is lost.
            if let Ok(jpeg) = codec::encode_jpeg(&picture, self.quality) {
                let stamp = Duration::from_secs_f64(capture.start);
                self.server.show(self.side as usize, jpeg, stamp);
            }
        }
    }
    /// The oldest of the frames that show what the newest does, the head at rest; `None` when
    /// there is nothing new.
    fn next_capture(&self, next: u64) -> Option<Capture> {
        self.pace.now(|world| {
            let side = self.side as usize;
            let newest = world.captures.back()?.base_from_optical[side];
            let mut due = world.captures.iter().filter(|c| c.sequence >= next);
            due.find(|c| c.base_from_optical[side] == newest).cloned()
        })
    }
}
