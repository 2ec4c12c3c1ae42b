//! Who moves the light for a calibration: a person at the terminal, or one in the simulator.

use std::io::{BufRead, Write};
use std::sync::Arc;

use nalgebra::{Point3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use vergence::{LightMover, Placed};
use vergence_devices::DeviceError;
use vergence_sim::Workcell;

/// What is known of the light's places beside what the heads see.
#[derive(Debug, Clone, Copy)]
pub struct Ruler {
    /// Places that are used, in pairs.
    pub places: usize,
    /// Length between the places of a pair, and its standard deviation (m).
    pub length: (f64, f64),
    /// Standard deviation (m) of each coordinate of places that are measured in base; `None` when
    /// they are not.
    pub measured: Option<f64>,
}

impl Ruler {
    /// A place (its number from 0), measured or not.
    fn placed(&self, number: usize, known: Option<Point3<f64>>) -> Placed {
        Placed {
            known: known.zip(self.measured),
            from_previous: (number % 2 == 1).then_some(self.length),
        }
    }
}

/// A person who is told what to do on standard error and says on standard input that it is done.
pub struct Person {
    ruler: Ruler,
    next: usize,
}

impl Person {
    /// Somebody with a ruler.
    pub fn new(ruler: Ruler) -> Self {
        Person { ruler, next: 0 }
    }
}

impl LightMover for Person {
    fn next_place(&mut self) -> Result<Option<Placed>, DeviceError> {
        let Ruler { places, length, measured } = self.ruler;
        if self.next == places {
            return Ok(None);
        }
        let how = match self.next % 2 {
            1 => format!("exactly {} m from where it is now, in any direction", length.0),
            _ => "anywhere before both heads, nearer and farther, left and right".into(),
        };
        let then = match measured {
            Some(_) => "type its x y z in base (m)",
            None => "press Enter",
        };
        let number = self.next + 1;
        loop {
            // Prompts that nobody can see are no reason to stop.
            let _ = write!(
                std::io::stderr(),
                "place {number} of {places}: put the light {how}; then {then} (q ends) "
            );
            let mut answer = String::new();
            match std::io::stdin().lock().read_line(&mut answer) {
                Ok(0) | Err(_) => return Ok(None),
                Ok(_) if answer.trim().eq_ignore_ascii_case("q") => return Ok(None),
                Ok(_) => {}
            }
            let known = coordinates(&answer);
            if measured.is_none() || known.is_some() {
                self.next += 1;
                return Ok(Some(self.ruler.placed(number - 1, known)));
            }
        }
    }
}

/// Three numbers, separated by spaces or commas.
pub fn coordinates(text: &str) -> Option<Point3<f64>> {
    let mut numbers = text.split([' ', ',']).map(str::trim).filter(|part| !part.is_empty());
    let mut next = || numbers.next()?.parse::<f64>().ok().filter(|x| x.is_finite());
    let point = Point3::new(next()?, next()?, next()?);
    numbers.next().is_none().then_some(point)
}

/// The simulator's person: holds the object before the heads, its light towards them, and errs with
/// the ruler as stated.
pub struct SimulatedPerson {
    workcell: Arc<Workcell>,
    object: String,
    ruler: Ruler,
    random: Pcg64Mcg,
    next: usize,
    light: Vector3<f64>,
}

impl SimulatedPerson {
    /// The same as [`Person::new`], with an object of the workcell.
    pub fn new(workcell: Arc<Workcell>, object: &str, ruler: Ruler, seed: u64) -> Self {
        SimulatedPerson {
            workcell,
            object: object.into(),
            ruler,
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

    fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.random.random::<f64>()).sum::<f64>() - 6.0
    }

    /// The ruler lies level, across the line of sight but for half a right angle either way.
    fn along_ruler(&mut self) -> Vector3<f64> {
        let (length, sigma) = self.ruler.length;
        let error = self.normal();
        let turn: f64 = self.random.random_range(-0.7..0.7);
        // Back towards the middle, so that the light stays before the heads.
        let side = -self.light.y.signum();
        Vector3::new(turn.sin(), side * turn.cos(), 0.0) * (length + sigma * error)
    }
}

impl LightMover for SimulatedPerson {
    fn next_place(&mut self) -> Result<Option<Placed>, DeviceError> {
        let number = self.next;
        if number == self.ruler.places {
            return Ok(None);
        }
        self.next += 1;
        self.light = match number % 2 {
            1 => self.light + self.along_ruler(),
            _ => self.anywhere(),
        };
        let shake = Vector3::from_fn(|_, _| self.normal());
        let known = self.ruler.measured.map(|sigma| Point3::from(self.light + shake * sigma));
        match self.workcell.hold_light(&self.object, &Point3::from(self.light)) {
            true => Ok(Some(self.ruler.placed(number, known))),
            false => Err(DeviceError::Unsupported {
                device: "simulated person".into(),
                what: format!("there is no object \"{}\" with a light to hold", self.object),
            }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_read_as_people_type_them() {
        assert_eq!(coordinates("0.5, -0.25 1\n"), Some(Point3::new(0.5, -0.25, 1.0)));
        for wrong in ["", "0.5 1", "1 2 3 4", "a b c", "1 2 nan"] {
            assert_eq!(coordinates(wrong), None, "{wrong}");
        }
    }
}
