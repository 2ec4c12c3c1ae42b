//! Time of a stereo pair at 320x240: with the heads at rest and with the heads turning.

use std::time::Duration;

use divan::Bencher;
use vergence_devices::Robot;
use vergence_sim::Workcell;

fn main() {
    divan::main();
}

fn robot() -> Robot {
    let cell = Workcell::embedded(1).expect("the embedded workcell is sound");
    let mut robot = cell.robot();
    aim(&mut robot, 0.35);
    robot.clock.sleep(Duration::from_secs(1));
    robot
}

fn aim(robot: &mut Robot, tilt: f64) {
    for head in &mut robot.heads {
        head.pan_tilt.move_to(0.2, tilt).expect("within the limits");
    }
}

fn pair(robot: &mut Robot) -> [u8; 2] {
    [0, 1].map(|side| {
        let frame = robot.heads[side].camera.next_frame(Duration::from_secs(1));
        frame.expect("a camera that works").image.data()[0]
    })
}

#[divan::bench]
fn heads_at_rest(bencher: Bencher) {
    let mut robot = robot();
    pair(&mut robot);
    bencher.bench_local(|| pair(&mut robot));
}

#[divan::bench]
fn heads_turning(bencher: Bencher) {
    let mut robot = robot();
    let mut down = false;
    bencher.bench_local(|| {
        down = !down;
        aim(&mut robot, if down { 0.45 } else { 0.25 });
        pair(&mut robot)
    });
}
