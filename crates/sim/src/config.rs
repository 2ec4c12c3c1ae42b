//! The simulator's own table `[sim]` of a robot's configuration.
//!
//! Every key is described in `assets/workcell.toml`, which holds the defaults; a wrong key is an
//! error that names it.

use serde::Deserialize;
use vergence_tag::Record;

use crate::error::SimError;

/// Six digits.
const MAX_PASSKEY: f64 = 999_999.0;

/// The whole table.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimConfig {
    /// What stands where.
    pub scenario: Scenario,
    /// Number of untagged things on the table.
    pub clutter: usize,
    /// Both cameras.
    pub camera: CameraSettings,
    /// All four servos.
    pub servos: ServoSettings,
    /// Deviation of the true head from the URDF.
    pub geometry_error: GeometryError,
    /// The tags' lights.
    pub led: LedSettings,
    /// Lamps and distracting lights.
    pub light: LightSettings,
    /// The radio.
    pub radio: RadioSettings,
    /// What the tag on the gripper tells, when the arm's configuration names one.
    pub gripper_record: Option<Record>,
    /// The tagged objects.
    pub objects: Vec<ObjectSettings>,
}

/// How the scene is composed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Scenario {
    /// Nothing hides a tagged object.
    #[default]
    Default,
    /// Something stands before the object "cup" (else before the last one); its LED stays in view.
    Occluded,
    /// The object "cup" stands within the arm's reach.
    Reach,
    /// Tagged objects rest on any side that they can, as if they had been dropped.
    Fallen,
}

/// Camera model.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CameraSettings {
    /// Frames per second.
    pub frame_rate: f64,
    /// Exposure of a row (s).
    pub exposure: f64,
    /// Brightness factor.
    pub gain: f64,
    /// Grey value = 255 linear^(1/gamma).
    pub gamma: f64,
    /// Electrons at white.
    pub full_well: f64,
    /// Electrons, standard deviation.
    pub read_noise: f64,
    /// Standard deviation of the lens's blur (px).
    pub psf_sigma_px: f64,
    /// Time between the starts of two rows (s).
    pub row_time: f64,
    /// 1 to 100, 0 for raw.
    pub jpeg_quality: u8,
    /// Frames kept for a slow reader.
    pub buffer_frames: usize,
}

/// Servo model.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ServoSettings {
    /// Encoder step (degrees); a servo rests anywhere within the step that it reads.
    pub resolution_deg: f64,
    /// Acceleration (rad/s^2).
    pub acceleration: f64,
    /// Dead band between motor and load (degrees) as stated for the kind; a joint has 70 to 100 %.
    pub backlash_deg: f64,
    /// From command to movement (s).
    pub latency: f64,
    /// Duration of an encoder reading (s).
    pub bus_time: f64,
}

/// Standard deviations of the true head's geometry around the URDF.
#[derive(Debug, Clone, Copy, PartialEq, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GeometryError {
    /// Joint zeros (degrees).
    pub joint_zero_deg: f64,
    /// Axis directions (degrees).
    pub axis_skew_deg: f64,
    /// Lever from tilt axis to camera (m, each component).
    pub lever_arm: f64,
    /// Focal length, relative.
    pub focal_ratio: f64,
}

/// The tags' lights.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LedSettings {
    /// Sum of pixel values at 1 m on the axis at an exposure of 4 ms, white = 1.
    pub flux_px: f64,
    /// Emitter's diameter (m).
    pub diameter: f64,
    /// Exponent of the cosine lobe.
    pub lobe_exponent: f64,
    /// Standard deviation of the tags' clock rates (parts per million).
    pub clock_ppm: f64,
    /// Longest play (s).
    pub longest_play: f64,
    /// Draw the tag's housing.
    pub housing: bool,
}

/// Lamps and distracting lights.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LightSettings {
    /// Factor on all lamps and the daylight.
    pub brightness: f64,
    /// Flicker of the ceiling lamp (Hz).
    pub lamp_hz: f64,
    /// Share of its light that flickers.
    pub lamp_depth: f64,
    /// Blink rate of the status light (Hz), 0 for none.
    pub status_hz: f64,
    /// A screen with changing pictures stands at the back.
    pub screen: bool,
}

/// Radio model.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RadioSettings {
    /// Reach (m).
    pub range: f64,
    /// Share of packets lost; the air sends lost ones again at the next event.
    pub loss: f64,
    /// Time between the advertisements of an idle tag (s).
    pub advertising_interval: f64,
    /// Time between a link's connection events (s): a request and its answer take two.
    pub connection_interval: f64,
}

/// A tagged object.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObjectSettings {
    /// What its tag tells, and what it is.
    pub record: Record,
    /// How its surface looks.
    #[serde(default)]
    pub surface: Surface,
    /// A cup's handle.
    #[serde(default)]
    pub handle: bool,
    /// Passkey that is printed on the tag (six digits): who pairs with it may write the record.
    /// Without one, every robot that pairs may.
    #[serde(default)]
    pub passkey: Option<u32>,
    /// Fixed place on the table (m, base).
    #[serde(default)]
    pub at: Option<[f64; 2]>,
    /// Fixed yaw (degrees, about z).
    #[serde(default)]
    pub yaw_deg: Option<f64>,
}

impl ObjectSettings {
    /// Plain, placed by chance, with a tag that every robot may write.
    pub fn of(record: Record) -> Self {
        let (surface, handle, passkey) = (Surface::default(), false, None);
        ObjectSettings { record, surface, handle, passkey, at: None, yaw_deg: None }
    }
}

/// How a surface looks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Surface {
    /// One tone.
    #[default]
    Plain,
    /// A label with lines and lettering.
    Printed,
    /// Bands around or along.
    Striped,
    /// Grain.
    Speckled,
}

impl Default for SimConfig {
    fn default() -> Self {
        SimConfig {
            scenario: Scenario::Default,
            clutter: 9,
            camera: CameraSettings::default(),
            servos: ServoSettings::default(),
            geometry_error: GeometryError::default(),
            led: LedSettings::default(),
            light: LightSettings::default(),
            radio: RadioSettings::default(),
            gripper_record: None,
            objects: Vec::new(),
        }
    }
}

impl Default for CameraSettings {
    fn default() -> Self {
        CameraSettings {
            frame_rate: 30.0,
            exposure: 0.004,
            gain: 1.0,
            gamma: 2.2,
            full_well: 12000.0,
            read_noise: 8.0,
            psf_sigma_px: 0.6,
            row_time: 0.0,
            jpeg_quality: 0,
            buffer_frames: 2,
        }
    }
}

impl Default for ServoSettings {
    fn default() -> Self {
        ServoSettings {
            resolution_deg: 0.35,
            acceleration: 40.0,
            backlash_deg: 0.15,
            latency: 0.008,
            bus_time: 0.001,
        }
    }
}

impl Default for LedSettings {
    fn default() -> Self {
        LedSettings {
            flux_px: 4.0,
            diameter: 0.003,
            lobe_exponent: 1.5,
            clock_ppm: 60.0,
            longest_play: 30.0,
            housing: true,
        }
    }
}

impl Default for LightSettings {
    fn default() -> Self {
        LightSettings {
            brightness: 1.0,
            lamp_hz: 100.0,
            lamp_depth: 0.35,
            status_hz: 1.7,
            screen: true,
        }
    }
}

impl Default for RadioSettings {
    fn default() -> Self {
        RadioSettings {
            range: 10.0,
            loss: 0.05,
            advertising_interval: 1.0,
            connection_interval: 0.015,
        }
    }
}

impl SimConfig {
    /// Reads the table and checks its numbers and records.
    pub fn from_table(table: &toml::Table) -> Result<Self, SimError> {
        let config: SimConfig = table
            .clone()
            .try_into()
            .map_err(|error: toml::de::Error| SimError::Table(error.to_string()))?;
        config.validate()?;
        Ok(config)
    }

    fn validate(&self) -> Result<(), SimError> {
        let (c, s, l) = (&self.camera, &self.servos, &self.light);
        let (r, g, e) = (&self.radio, &self.geometry_error, &self.led);
        // Key, value, smallest and largest that the models can bear.
        let ranges = [
            ("camera.frame_rate", c.frame_rate, 1.0, 1000.0),
            ("camera.exposure", c.exposure, 1e-6, 1.0 / c.frame_rate.clamp(1.0, 1000.0)),
            ("camera.gain", c.gain, 1e-3, 1e3),
            ("camera.gamma", c.gamma, 0.2, 5.0),
            ("camera.full_well", c.full_well, 10.0, 1e7),
            ("camera.read_noise", c.read_noise, 0.0, 1e5),
            ("camera.psf_sigma_px", c.psf_sigma_px, 0.1, 10.0),
            ("camera.row_time", c.row_time, 0.0, 1e-3),
            ("camera.jpeg_quality", f64::from(c.jpeg_quality), 0.0, 100.0),
            ("camera.buffer_frames", c.buffer_frames as f64, 1.0, 1000.0),
            ("servos.resolution_deg", s.resolution_deg, 1e-4, 10.0),
            ("servos.acceleration", s.acceleration, 0.1, 1e5),
            ("servos.backlash_deg", s.backlash_deg, 0.0, 10.0),
            ("servos.latency", s.latency, 0.0, 1.0),
            ("servos.bus_time", s.bus_time, 1e-5, 1.0),
            ("geometry_error.joint_zero_deg", g.joint_zero_deg, 0.0, 20.0),
            ("geometry_error.axis_skew_deg", g.axis_skew_deg, 0.0, 20.0),
            ("geometry_error.lever_arm", g.lever_arm, 0.0, 0.1),
            ("geometry_error.focal_ratio", g.focal_ratio, 0.0, 0.2),
            ("led.flux_px", e.flux_px, 0.0, 1e4),
            ("led.diameter", e.diameter, 1e-4, 0.05),
            ("led.lobe_exponent", e.lobe_exponent, 0.0, 100.0),
            ("led.clock_ppm", e.clock_ppm, 0.0, 1e4),
            ("led.longest_play", e.longest_play, 0.1, 1e5),
            ("light.brightness", l.brightness, 0.0, 100.0),
            ("light.lamp_hz", l.lamp_hz, 1.0, 1e5),
            ("light.lamp_depth", l.lamp_depth, 0.0, 1.0),
            ("light.status_hz", l.status_hz, 0.0, 500.0),
            ("radio.range", r.range, 0.0, 1e4),
            ("radio.loss", r.loss, 0.0, 0.95),
            // The limits of Bluetooth; of a link that is lost after two seconds of silence.
            ("radio.advertising_interval", r.advertising_interval, 0.02, 10.24),
            ("radio.connection_interval", r.connection_interval, 0.0075, 0.5),
            ("clutter", self.clutter as f64, 0.0, 60.0),
        ];
        for (key, value, low, high) in ranges {
            if !(low..=high).contains(&value) {
                return Err(SimError::Range { key, value, low, high });
            }
        }
        for record in self.objects.iter().map(|o| &o.record).chain(&self.gripper_record) {
            record
                .validate()
                .map_err(|why| SimError::Record { id: record.object_id.to_string(), why })?;
        }
        for object in &self.objects {
            let value = object.passkey.map_or(0.0, f64::from);
            if value > MAX_PASSKEY {
                return Err(SimError::Range {
                    key: "objects.passkey",
                    value,
                    low: 0.0,
                    high: MAX_PASSKEY,
                });
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<SimConfig, SimError> {
        SimConfig::from_table(&text.parse().unwrap())
    }

    #[test]
    fn the_file_shows_the_defaults() {
        let file: toml::Table = crate::EMBEDDED_CONFIG.parse().unwrap();
        let mut shown = SimConfig::from_table(file["sim"].as_table().unwrap()).unwrap();
        assert_eq!(shown.objects.len(), 3);
        assert!(shown.gripper_record.take().is_some());
        shown.objects.clear();
        assert_eq!(shown, SimConfig::default());
    }

    #[test]
    fn wrong_keys_and_numbers_are_named() {
        let message = |text: &str| parse(text).unwrap_err().to_string();
        assert!(message("[camera]\nexposur = 1").contains("exposur"));
        assert!(message("[camera]\nexposure = 1.0").contains("camera.exposure"));
        assert!(message("[radio]\nloss = nan").contains("radio.loss"));
    }
}
