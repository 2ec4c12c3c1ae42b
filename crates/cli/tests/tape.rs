//! The whole find from a tape: every answer that the devices gave once (encoder readings, pictures
//! as PNG bytes, radio bytes) is played back with the simulator gone. The same report must come out,
//! so nothing but pixels, angles and packets can have gone in.

// Helpers outside of test functions fail a test by panicking, too.
#![allow(clippy::unwrap_used)]

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use vergence::{FindConfig, Report, System};
use vergence_devices::{
    Advertisement, Camera, Clock, DeviceError, Head, JointReading, LedCommand, PanTilt, Robot,
    TagAddress, TagLink, TagState,
};
use vergence_imaging::{Frame, Image, codec};
use vergence_sim::Workcell;

/// Answers of one device in order.
struct Tape<T>(Arc<Mutex<VecDeque<T>>>);

impl<T> Default for Tape<T> {
    fn default() -> Self {
        Tape(Arc::default())
    }
}

impl<T> Clone for Tape<T> {
    fn clone(&self) -> Self {
        Tape(self.0.clone())
    }
}

impl<T: Clone> Tape<T> {
    /// Writes an answer down and passes it on.
    fn record(&self, answer: T) -> T {
        self.0.lock().unwrap().push_back(answer.clone());
        answer
    }

    /// The next answer.
    fn play(&self) -> T {
        self.0.lock().unwrap().pop_front().expect("the run asks for more than was recorded")
    }
}

/// A picture as a file would hold it, with its times.
#[derive(Clone)]
struct Still {
    png: Vec<u8>,
    times: Frame,
}

impl Still {
    fn of(frame: &Frame) -> Self {
        let png = codec::encode_png(&frame.image).unwrap();
        Still { png, times: Frame { image: Image::filled(0, 0, 0), ..frame.clone() } }
    }

    fn frame(self) -> Frame {
        Frame { image: codec::decode(&self.png).unwrap(), ..self.times }
    }
}

type Answer<T> = Result<T, DeviceError>;

#[derive(Clone, Default)]
struct Tapes {
    now: Tape<Duration>,
    frames: [Tape<Answer<Still>>; 2],
    moves: [Tape<Answer<()>>; 2],
    joints: [Tape<Answer<JointReading>>; 2],
    servos: [Tape<(f64, f64)>; 2],
    scans: Tape<Answer<Vec<Advertisement>>>,
    records: Tape<Answer<Vec<u8>>>,
    states: Tape<Answer<TagState>>,
}

/// A device that writes its answers to a tape, or plays them from it when there is none behind.
struct Taped<D: ?Sized> {
    tapes: Tapes,
    side: usize,
    device: Option<Box<D>>,
}

impl Clock for Taped<dyn Clock> {
    fn now(&self) -> Duration {
        match &self.device {
            Some(clock) => self.tapes.now.record(clock.now()),
            None => self.tapes.now.play(),
        }
    }

    fn sleep(&self, duration: Duration) {
        if let Some(clock) = &self.device {
            clock.sleep(duration);
        }
    }
}

impl Camera for Taped<dyn Camera> {
    fn next_frame(&mut self, timeout: Duration) -> Answer<Frame> {
        let tape = &self.tapes.frames[self.side];
        match &mut self.device {
            Some(camera) => tape.record(camera.next_frame(timeout).map(|f| Still::of(&f))),
            None => tape.play(),
        }
        .map(Still::frame)
    }
}

impl PanTilt for Taped<dyn PanTilt> {
    fn move_to(&mut self, pan: f64, tilt: f64) -> Answer<()> {
        let tape = &self.tapes.moves[self.side];
        match &mut self.device {
            Some(servos) => tape.record(servos.move_to(pan, tilt)),
            None => tape.play(),
        }
    }

    fn read(&mut self) -> Answer<JointReading> {
        let tape = &self.tapes.joints[self.side];
        match &mut self.device {
            Some(servos) => tape.record(servos.read()),
            None => tape.play(),
        }
    }

    fn resolution(&self) -> f64 {
        self.data().0
    }

    fn backlash(&self) -> f64 {
        self.data().1
    }
}

impl Taped<dyn PanTilt> {
    fn data(&self) -> (f64, f64) {
        let tape = &self.tapes.servos[self.side];
        match &self.device {
            Some(servos) => tape.record((servos.resolution(), servos.backlash())),
            None => tape.play(),
        }
    }
}

impl TagLink for Taped<dyn TagLink> {
    fn scan(&mut self, window: Duration) -> Answer<Vec<Advertisement>> {
        match &mut self.device {
            Some(radio) => self.tapes.scans.record(radio.scan(window)),
            None => self.tapes.scans.play(),
        }
    }

    fn read_record(&mut self, tag: TagAddress, timeout: Duration) -> Answer<Vec<u8>> {
        match &mut self.device {
            Some(radio) => self.tapes.records.record(radio.read_record(tag, timeout)),
            None => self.tapes.records.play(),
        }
    }

    fn command(
        &mut self,
        tag: TagAddress,
        command: LedCommand,
        timeout: Duration,
    ) -> Answer<TagState> {
        match &mut self.device {
            Some(radio) => self.tapes.states.record(radio.command(tag, command, timeout)),
            None => self.tapes.states.play(),
        }
    }
}

/// The robot with tapes: recording what `devices` answer, or playing when there are none.
fn taped(tapes: &Tapes, devices: Option<Robot>) -> Robot {
    fn tape<D: ?Sized>(tapes: &Tapes, side: usize, device: Option<Box<D>>) -> Box<Taped<D>> {
        Box::new(Taped { tapes: tapes.clone(), side, device })
    }
    let (clock, heads, radio) = match devices {
        Some(Robot { clock, heads, radio, .. }) => (Some(clock), heads.map(Some), Some(radio)),
        None => (None, [None, None], None),
    };
    let mut side = 0;
    let heads = heads.map(|head| {
        let (camera, pan_tilt) = match head {
            Some(Head { camera, pan_tilt }) => (Some(camera), Some(pan_tilt)),
            None => (None, None),
        };
        let head =
            Head { camera: tape(tapes, side, camera), pan_tilt: tape(tapes, side, pan_tilt) };
        side += 1;
        head
    });
    Robot { clock: tape(tapes, 0, clock), heads, radio: tape(tapes, 0, radio), arm: None }
}

fn find(robot: Robot) -> Report {
    let (config, description) = vergence_sim::embedded_files().unwrap();
    let mut system = System::new(robot, &config, &description).unwrap();
    vergence::find(&mut system, "cup", &FindConfig::default(), &mut ())
}

#[test]
fn a_find_needs_nothing_but_what_devices_answer() {
    let tapes = Tapes::default();
    let recorded = {
        let workcell = Workcell::embedded(1).unwrap();
        find(taped(&tapes, Some(workcell.robot())))
    };
    assert!(recorded.found, "{:?}", recorded.reason);
    let played = find(taped(&tapes, None));
    assert_eq!(played, recorded);
    assert!(played.truth.is_none());
}
