//! Who moves the light for a calibration: a person at the terminal, or one in the simulator.

use std::io::{BufRead, Write};
use std::sync::Arc;

use nalgebra::{Translation3, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use vergence::{LightMover, Placed};
use vergence_devices::DeviceError;
use vergence_geometry::Transform;
use vergence_sim::Workcell;

/// A length and its standard deviation (m).
type Length = (f64, f64);

/// A person who is told what to do on standard error and says on standard input that it is done.
pub struct Person {
    places: usize,
    length: Length,
    next: usize,
}

impl Person {
    /// Somebody who puts the light to so many places, every second one a length from the one before.
    pub fn new(places: usize, length: Length) -> Self {
        Person { places, length, next: 0 }
    }
}

impl LightMover for Person {
    fn next_place(&mut self) -> Result<Option<Placed>, DeviceError> {
        if self.next == self.places {
            return Ok(None);
        }
        let second = self.next % 2 == 1;
        let how = match second {
            true => format!("exactly {} m from where it is now, in any direction", self.length.0),
            false => "anywhere before both heads, nearer and farther, left and right".into(),
        };
        let (number, places) = (self.next + 1, self.places);
        // Prompts that nobody can see are no reason to stop.
        let _ = write!(
            std::io::stderr(),
            "place {number} of {places}: put the light {how}; then press Enter (q ends) "
        );
        let mut answer = String::new();
        let read = std::io::stdin().lock().read_line(&mut answer);
        match read {
            Ok(0) | Err(_) => return Ok(None),
            Ok(_) if answer.trim().eq_ignore_ascii_case("q") => return Ok(None),
            Ok(_) => {}
        }
        self.next += 1;
        Ok(Some(Placed { known: None, from_previous: second.then_some(self.length) }))
    }
}

/// The simulator's person: holds the object before the heads, its light towards them, and errs with
/// the ruler as stated.
pub struct SimulatedPerson {
    workcell: Arc<Workcell>,
    object: String,
    places: usize,
    length: Length,
    random: Pcg64Mcg,
    next: usize,
    light: Vector3<f64>,
}

impl SimulatedPerson {
    /// The same as [`Person::new`], with an object of the workcell.
    pub fn new(
        workcell: Arc<Workcell>,
        object: &str,
        places: usize,
        length: Length,
        seed: u64,
    ) -> Self {
        SimulatedPerson {
            workcell,
            object: object.into(),
            places,
            length,
            random: Pcg64Mcg::seed_from_u64(seed),
            next: 0,
            light: Vector3::zeros(),
        }
    }

    /// Somewhere in a sector before the heads, above the table: 0.6 to 1.5 m away.
    fn anywhere(&mut self) -> Vector3<f64> {
        let distance = self.random.random_range(0.6..1.5);
        let bearing: f64 = self.random.random_range(-0.6..0.6);
        let height = self.random.random_range(0.15..0.6);
        Vector3::new(distance * bearing.cos(), distance * bearing.sin(), height)
    }

    /// The ruler lies level, across the line of sight but for half a right angle either way.
    fn along_ruler(&mut self) -> Vector3<f64> {
        let (length, sigma) = self.length;
        let error = (0..12).map(|_| self.random.random::<f64>()).sum::<f64>() - 6.0;
        let turn: f64 = self.random.random_range(-0.7..0.7);
        // Back towards the middle, so that the light stays before the heads.
        let side = -self.light.y.signum();
        Vector3::new(turn.sin(), side * turn.cos(), 0.0) * (length + sigma * error)
    }
}

impl LightMover for SimulatedPerson {
    fn next_place(&mut self) -> Result<Option<Placed>, DeviceError> {
        if self.next == self.places {
            return Ok(None);
        }
        let second = self.next % 2 == 1;
        self.next += 1;
        self.light = match second {
            true => self.light + self.along_ruler(),
            false => self.anywhere(),
        };
        let missing = || DeviceError::Unsupported {
            device: "simulated person".into(),
            what: format!("there is no object \"{}\" with a light to hold", self.object),
        };
        let truth = self.workcell.truth();
        let object = truth.objects.iter().find(|o| o.id == self.object).ok_or_else(missing)?;
        let site = object.record.landmarks.first().ok_or_else(missing)?;
        // Upright, the light's normal turned towards the foot of the mast.
        let facing = (-self.light.y).atan2(-self.light.x);
        let normal = Vector3::from(site.normal);
        let yaw = facing - normal.y.atan2(normal.x);
        let turned = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw);
        let centre = self.light - turned * Vector3::from(site.position);
        let place = Transform::from_parts(Translation3::from(centre), turned);
        match self.workcell.place_object(&self.object, &place) {
            true => Ok(Some(Placed { known: None, from_previous: second.then_some(self.length) })),
            false => Err(missing()),
        }
    }
}
