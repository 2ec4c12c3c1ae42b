//! Time of one plan for a cup on a table: `cargo bench -p vergence-grasp`.

use std::path::Path;

use nalgebra::{Matrix6, Translation3, Vector3};
use vergence_devices::Description;
use vergence_geometry::{GaussianPose, Solid};
use vergence_grasp::{Config, Obstacle, Request, Robot};

fn main() {
    divan::main();
}

#[divan::bench]
fn plan(bencher: divan::Bencher) {
    let text = include_str!("../assets/arm.urdf");
    let make = || -> Result<_, Box<dyn std::error::Error>> {
        let description = Description::parse(text, Path::new("arm.urdf"))?;
        let chain = description.chain("base", "tcp")?;
        let bodies = description.bodies("base", &chain)?;
        let gripper = description.gripper("hand")?;
        Ok(Robot::new(chain, &bodies, gripper.travel, gripper.effort)?)
    };
    let Ok(robot) = make() else { return };
    let json = r#"{"object_id": "cup", "bounding_box": {"width": 0.084, "length": 0.084, "height": 0.096},
        "shape": {"kind": "cup", "top_diameter": 0.084, "bottom_diameter": 0.062, "height": 0.096},
        "landmarks": [{"position": [-0.039, 0, 0.012], "normal": [-0.993498, 0, -0.113839]}],
        "physical": {"weight": 0.28, "strength": 40.0, "material": "ceramic"}}"#;
    let Ok(record) = serde_json::from_str(json) else { return };
    let object = GaussianPose {
        pose: Translation3::new(0.6, 0.0, 0.048).into(),
        covariance: Matrix6::identity() * 2.5e-6,
    };
    let table = Obstacle {
        name: "table".into(),
        base_from_solid: Translation3::new(0.75, 0.0, -0.02).into(),
        solid: Solid::Cuboid { half: Vector3::new(0.6, 0.9, 0.02) },
    };
    let request = Request {
        record: &record,
        object: &object,
        landmark: 0,
        start: &[-0.9, -0.6, 1.3, 0.0, 0.9, 0.0],
        obstacles: &[table],
        free_azimuths: &[],
        seed: 1,
    };
    // A refusal would be fast.
    let planned = vergence_grasp::plan(&robot, &request, &Config::default());
    assert!(planned.is_ok(), "{planned:?}");
    bencher.bench_local(|| vergence_grasp::plan(&robot, &request, &Config::default()));
}
