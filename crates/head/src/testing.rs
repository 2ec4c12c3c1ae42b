//! A head as the tests need it: lever arms on every link, 0.2 m baseline, 320x240 pixels.

use nalgebra::{Translation3, Vector3};
use vergence_geometry::{Camera, Chain, Joint, Limits, Transform, optical_from_body};

use crate::PanTiltHead;

/// Left or right head of the test robot; `y` is the place of its pan axis in base.
pub(crate) fn head(y: f64) -> PanTiltHead {
    let joint = |name: &str, origin: [f64; 3], axis, lower, upper| Joint {
        name: name.into(),
        parent_from_joint: Transform::translation(origin[0], origin[1], origin[2]),
        axis,
        limits: Limits { lower, upper, velocity: 3.6 },
    };
    let chain = Chain {
        joints: vec![
            joint("pan", [0.0, y, 0.5], Vector3::z_axis(), -1.8, 1.8),
            joint("tilt", [0.012, 0.0, 0.04], Vector3::y_axis(), -0.8, 1.2),
        ],
        last_from_tip: Transform::from_parts(
            Translation3::new(0.025, 0.0, 0.015),
            optical_from_body().inverse(),
        ),
    };
    PanTiltHead::new(chain, Camera::centred(320, 240, 300.0)).unwrap()
}

/// Both heads.
pub(crate) fn heads() -> [PanTiltHead; 2] {
    [head(0.1), head(-0.1)]
}
