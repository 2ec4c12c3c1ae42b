//! The record of an object (Table 1 of the paper) and what makes one impossible.

use heapless::Vec;

use crate::Vec3;
use crate::shown::is_obeyed;

/// Short text in a record: identifiers, names, materials.
pub type Text = heapless::String<48>;

/// Largest number of landmarks on one tag.
pub const MAX_LANDMARKS: usize = 8;
/// Largest number of corners of an extruded polygon.
pub const MAX_OUTLINE: usize = 24;
/// Largest number of vertices of a convex mesh.
pub const MAX_VERTICES: usize = 48;

/// What a tag tells of the object that carries it. SI units, object frame.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "std", derive(serde::Serialize, serde::Deserialize))]
pub struct Record {
    /// The object's identifier.
    pub object_id: Text,
    /// The LEDs, at least one.
    pub landmarks: Vec<LandmarkSite, MAX_LANDMARKS>,
    /// The size of the object.
    pub bounding_box: BoundingBox,
    /// The form within the bounding box.
    pub shape: Shape,
    /// Weight, strength, material.
    #[cfg_attr(feature = "std", serde(default))]
    pub physical: Physical,
    /// Name and mobility.
    #[cfg_attr(feature = "std", serde(default))]
    pub semantic: Semantic,
}

/// An LED on the object.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "std", derive(serde::Serialize, serde::Deserialize))]
pub struct LandmarkSite {
    /// Where it is in the object frame (m).
    pub position: Vec3,
    /// Outward unit normal of the surface that it sits on: the axis of its lobe.
    pub normal: Vec3,
}

/// Sides of the bounding box (m).
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "std", derive(serde::Serialize, serde::Deserialize))]
pub struct BoundingBox {
    /// Along x.
    pub width: f64,
    /// Along y.
    pub length: f64,
    /// Along z.
    pub height: f64,
}

impl BoundingBox {
    /// Width, length, height: the sides along x, y, z.
    pub fn sides(&self) -> Vec3 {
        [self.width, self.length, self.height]
    }

    /// The space diagonal.
    pub fn diagonal(&self) -> f64 {
        let [x, y, z] = self.sides();
        libm_sqrt(x * x + y * y + z * z)
    }
}

/// The form of the object; every form is centred in the bounding box.
// A mesh is large and cannot be boxed: the firmware has no heap.
#[allow(clippy::large_enum_variant)]
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "std", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "std", serde(tag = "kind", rename_all = "snake_case"))]
pub enum Shape {
    /// The bounding box itself.
    Box,
    /// Upright cylinder about z.
    Cylinder {
        /// Diameter (m).
        diameter: f64,
        /// Height (m).
        height: f64,
    },
    /// Frustum about z, open at the top (+z); may have a handle that the record does not tell of.
    Cup {
        /// Outer diameter of the rim (m).
        top_diameter: f64,
        /// Outer diameter of the foot (m).
        bottom_diameter: f64,
        /// Height (m).
        height: f64,
    },
    /// Ball.
    Sphere {
        /// Diameter (m).
        diameter: f64,
    },
    /// Polygon in the x-y plane, counter-clockwise, extruded along z over the whole height.
    Prism {
        /// Corners (m).
        outline: Vec<[f64; 2], MAX_OUTLINE>,
        /// Height (m).
        height: f64,
    },
    /// Convex hull of these vertices.
    Convex {
        /// Vertices (m).
        vertices: Vec<Vec3, MAX_VERTICES>,
    },
}

/// Physical information.
#[derive(Debug, Clone, PartialEq, Default)]
#[cfg_attr(feature = "std", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "std", serde(default))]
pub struct Physical {
    /// Mass (kg).
    pub weight: Option<f64>,
    /// Largest squeezing force that the object bears (N).
    pub strength: Option<f64>,
    /// What it is made of.
    pub material: Option<Text>,
}

/// Semantic information.
#[derive(Debug, Clone, PartialEq, Default)]
#[cfg_attr(feature = "std", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "std", serde(default))]
pub struct Semantic {
    /// What it is: "cup".
    pub name: Text,
    /// Whether it may be moved.
    pub mobility: Mobility,
}

/// Whether an object may be moved.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "std", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "std", serde(rename_all = "snake_case"))]
pub enum Mobility {
    /// A robot may take it.
    #[default]
    Movable,
    /// It stays where it is.
    Fixed,
}

/// A record that cannot be true.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Invalid {
    /// A number is not finite.
    #[error("{0} is not a finite number")]
    NotFinite(&'static str),
    /// A size, weight or strength is zero or negative, or beyond ten metres or tonnes.
    #[error("{0} must be positive and below ten metres (or tonnes)")]
    Size(&'static str),
    /// A text that must not be empty is.
    #[error("{0} is empty")]
    Empty(&'static str),
    /// A text holds what a terminal would obey instead of showing it.
    #[error("{0} holds a control character")]
    Control(&'static str),
    /// The landmark lies further from the box than its housing can explain.
    #[error("landmarks: one lies more than 20 mm outside the bounding box")]
    LandmarkOutside,
    /// The normal is not a unit vector.
    #[error("landmarks: a normal is not a unit vector")]
    Normal,
    /// The form does not fill its bounding box (to within 2 mm).
    #[error("shape does not fit the bounding box")]
    ShapeOutsideBox,
    /// Fewer corners than a solid needs, corners in one place, or a polygon that crosses itself or does
    /// not run counter-clockwise.
    #[error("{0} does not describe a solid")]
    Degenerate(&'static str),
}

/// How far outside the box a landmark may sit: its housing stands on the surface.
const LANDMARK_SLACK: f64 = 0.020;
/// How far a form may deviate from its box: rounding of the record's numbers.
const SHAPE_SLACK: f64 = 0.002;

impl Record {
    /// Refuses records that cannot be true, naming the field.
    pub fn validate(&self) -> Result<(), Invalid> {
        if self.object_id.trim().is_empty() {
            return Err(Invalid::Empty("object_id"));
        }
        shows("object_id", &self.object_id)?;
        shows("semantic.name", &self.semantic.name)?;
        if let Some(material) = &self.physical.material {
            shows("physical.material", material)?;
        }
        size("bounding_box.width", self.bounding_box.width)?;
        size("bounding_box.length", self.bounding_box.length)?;
        size("bounding_box.height", self.bounding_box.height)?;
        if self.landmarks.is_empty() {
            return Err(Invalid::Empty("landmarks"));
        }
        let half = self.bounding_box.sides().map(|s| s / 2.0);
        for site in &self.landmarks {
            finite("landmarks.position", &site.position)?;
            finite("landmarks.normal", &site.normal)?;
            if (0..3).any(|k| site.position[k].abs() > half[k] + LANDMARK_SLACK) {
                return Err(Invalid::LandmarkOutside);
            }
            let norm2: f64 = site.normal.iter().map(|n| n * n).sum();
            if !(0.98..=1.02).contains(&norm2) {
                return Err(Invalid::Normal);
            }
        }
        if let Some(weight) = self.physical.weight {
            size("physical.weight", weight / 1000.0)?;
        }
        if let Some(strength) = self.physical.strength {
            size("physical.strength", strength / 1e5)?;
        }
        self.validate_shape()
    }

    fn validate_shape(&self) -> Result<(), Invalid> {
        let [w, l, h] = self.bounding_box.sides();
        let fits = |sides: Vec3| {
            let close = |a: f64, b: f64| (a - b).abs() <= SHAPE_SLACK;
            match close(sides[0], w) && close(sides[1], l) && close(sides[2], h) {
                true => Ok(()),
                false => Err(Invalid::ShapeOutsideBox),
            }
        };
        match &self.shape {
            Shape::Box => Ok(()),
            Shape::Cylinder { diameter, height } => {
                size("shape.diameter", *diameter)?;
                size("shape.height", *height)?;
                fits([*diameter, *diameter, *height])
            }
            Shape::Cup { top_diameter, bottom_diameter, height } => {
                size("shape.top_diameter", *top_diameter)?;
                size("shape.bottom_diameter", *bottom_diameter)?;
                size("shape.height", *height)?;
                let widest = top_diameter.max(*bottom_diameter);
                fits([widest, widest, *height])
            }
            Shape::Sphere { diameter } => {
                size("shape.diameter", *diameter)?;
                fits([*diameter; 3])
            }
            Shape::Prism { outline, height } => {
                size("shape.height", *height)?;
                for corner in outline {
                    finite("shape.outline", corner)?;
                }
                let n = outline.len();
                let area2: f64 = (0..n)
                    .map(|i| (outline[i], outline[(i + 1) % n]))
                    .map(|(a, b)| a[0] * b[1] - a[1] * b[0])
                    .sum();
                if n < 3 || area2 <= 0.0 || !is_simple(outline) {
                    return Err(Invalid::Degenerate("shape.outline"));
                }
                let [x, y] = [0, 1].map(|k| extent(outline.iter().map(|c| c[k])));
                fits([x, y, *height])
            }
            Shape::Convex { vertices } => {
                for vertex in vertices {
                    finite("shape.vertices", vertex)?;
                }
                if vertices.len() < 4 || are_flat(vertices) {
                    return Err(Invalid::Degenerate("shape.vertices"));
                }
                fits([0, 1, 2].map(|k| extent(vertices.iter().map(|v| v[k]))))
            }
        }
    }
}

/// Corners nearer than this (m) are one.
const NEAR: f64 = 1e-6;
/// What is no thicker than this (m) is flat.
const THIN: f64 = 1e-4;

/// Whether no edge of a polygon is a point and no two meet but neighbours at their corner.
fn is_simple(outline: &[[f64; 2]]) -> bool {
    let n = outline.len();
    let corner = |i: usize| outline[i % n];
    // Twice the area of a triangle, positive when it runs counter-clockwise.
    let turn = |a: [f64; 2], b: [f64; 2], c: [f64; 2]| {
        (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    };
    // Whether a point in line with the ends of an edge lies between them.
    let between = |a: [f64; 2], b: [f64; 2], c: [f64; 2]| {
        (0..2).all(|k| c[k] >= a[k].min(b[k]) && c[k] <= a[k].max(b[k]))
    };
    let long = |i: usize| (0..2).any(|k| (corner(i)[k] - corner(i + 1)[k]).abs() > NEAR);
    let meet = |i: usize, j: usize| {
        let (a, b, c, d) = (corner(i), corner(i + 1), corner(j), corner(j + 1));
        let of_first = [turn(a, b, c), turn(a, b, d)];
        let of_second = [turn(c, d, a), turn(c, d, b)];
        let crosses = |t: [f64; 2]| (t[0] > 0.0) != (t[1] > 0.0) && t[0] != 0.0 && t[1] != 0.0;
        (crosses(of_first) && crosses(of_second))
            || (of_first[0] == 0.0 && between(a, b, c))
            || (of_first[1] == 0.0 && between(a, b, d))
            || (of_second[0] == 0.0 && between(c, d, a))
            || (of_second[1] == 0.0 && between(c, d, b))
    };
    // Neighbours share a corner; they may not run back on each other.
    let runs_back = |i: usize| {
        let (a, b, c) = (corner(i), corner(i + 1), corner(i + 2));
        let ahead: f64 = (0..2).map(|k| (b[k] - a[k]) * (c[k] - b[k])).sum();
        turn(a, b, c) == 0.0 && ahead < 0.0
    };
    let apart = |i: usize, j: usize| j > i + 1 && (j + 1) % n != i;
    (0..n).all(|i| long(i) && !runs_back(i) && (0..n).all(|j| !apart(i, j) || !meet(i, j)))
}

/// Whether all points lie in one plane.
fn are_flat(points: &[[f64; 3]]) -> bool {
    let from =
        |i: usize, j: usize| -> [f64; 3] { core::array::from_fn(|k| points[j][k] - points[i][k]) };
    let cross = |a: [f64; 3], b: [f64; 3]| -> [f64; 3] {
        core::array::from_fn(|k| {
            let (l, m) = ((k + 1) % 3, (k + 2) % 3);
            a[l] * b[m] - a[m] * b[l]
        })
    };
    let dot = |a: [f64; 3], b: [f64; 3]| -> f64 { (0..3).map(|k| a[k] * b[k]).sum() };
    let longest = |a: &[f64; 3], b: &[f64; 3]| dot(*a, *a).total_cmp(&dot(*b, *b));
    // The widest triangle with the first point says which plane it would be.
    let n = points.len();
    let Some(along) = (1..n).map(|i| from(0, i)).max_by(longest) else { return true };
    let normals = (1..n).map(|i| cross(along, from(0, i)));
    let Some(normal) = normals.max_by(longest) else { return true };
    let length = libm_sqrt(dot(normal, normal));
    (1..n).all(|i| dot(normal, from(0, i)).abs() <= THIN * length)
}

/// Side of a centred bounding interval of these values: twice the largest magnitude.
fn extent(values: impl Iterator<Item = f64>) -> f64 {
    2.0 * values.fold(0.0, |widest: f64, v| widest.max(v.abs()))
}

fn shows(field: &'static str, text: &str) -> Result<(), Invalid> {
    match text.contains(is_obeyed) {
        true => Err(Invalid::Control(field)),
        false => Ok(()),
    }
}

fn finite(field: &'static str, values: &[f64]) -> Result<(), Invalid> {
    match values.iter().all(|v| v.is_finite()) {
        true => Ok(()),
        false => Err(Invalid::NotFinite(field)),
    }
}

fn size(field: &'static str, value: f64) -> Result<(), Invalid> {
    finite(field, &[value])?;
    match value > 0.0 && value < 10.0 {
        true => Ok(()),
        false => Err(Invalid::Size(field)),
    }
}

/// Square root without `std`: Newton from an exponent-halved start, exact to rounding.
fn libm_sqrt(x: f64) -> f64 {
    if x <= 0.0 {
        return 0.0;
    }
    let mut root = f64::from_bits((x.to_bits() >> 1) + (1023 << 51));
    for _ in 0..6 {
        root = 0.5 * (root + x / root);
    }
    root
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cup() -> Record {
        serde_json::from_str(
            r#"{"object_id": "cup", "landmarks": [{"position": [0.04, 0.0, 0.0], "normal": [1, 0, 0]}],
                "bounding_box": {"width": 0.08, "length": 0.08, "height": 0.09},
                "shape": {"kind": "cup", "top_diameter": 0.08, "bottom_diameter": 0.06, "height": 0.09},
                "physical": {"weight": 0.3, "strength": null, "material": "ceramic"},
                "semantic": {"name": "cup", "mobility": "movable"}, "colour": "unknown keys are read over"}"#,
        )
        .unwrap()
    }

    #[test]
    fn a_true_record_is_accepted() {
        assert_eq!(cup().validate(), Ok(()));
        assert!((cup().bounding_box.diagonal() - 0.0209f64.sqrt()).abs() < 1e-15);
    }

    #[test]
    fn the_impossible_is_refused_by_name() {
        let check = |change: fn(&mut Record), expected: Invalid| {
            let mut record = cup();
            change(&mut record);
            assert_eq!(record.validate(), Err(expected));
        };
        check(|r| r.bounding_box.width = -0.1, Invalid::Size("bounding_box.width"));
        check(|r| r.bounding_box.height = f64::NAN, Invalid::NotFinite("bounding_box.height"));
        check(|r| r.landmarks[0].position[0] = 0.2, Invalid::LandmarkOutside);
        check(|r| r.landmarks[0].normal = [0.0; 3], Invalid::Normal);
        check(|r| r.landmarks.clear(), Invalid::Empty("landmarks"));
        check(|r| r.object_id.clear(), Invalid::Empty("object_id"));
        let text = |text: &str| Text::try_from(text).unwrap();
        for bad in ["cup\x1b[2J", "cup\n", "\u{202e}puc"].map(text) {
            let (mut id, mut name, mut material) = (cup(), cup(), cup());
            id.object_id = bad.clone();
            name.semantic.name = bad.clone();
            material.physical.material = Some(bad);
            assert_eq!(id.validate(), Err(Invalid::Control("object_id")));
            assert_eq!(name.validate(), Err(Invalid::Control("semantic.name")));
            assert_eq!(material.validate(), Err(Invalid::Control("physical.material")));
        }
        check(|r| r.physical.weight = Some(0.0), Invalid::Size("physical.weight"));
        check(|r| r.shape = Shape::Sphere { diameter: 0.3 }, Invalid::ShapeOutsideBox);
        let flat = heapless::Vec::from_slice(&[[0.04, 0.0], [0.0, 0.04]]).unwrap();
        let mut record = cup();
        record.shape = Shape::Prism { outline: flat, height: 0.09 };
        assert_eq!(record.validate(), Err(Invalid::Degenerate("shape.outline")));
    }

    #[test]
    fn what_encloses_nothing_is_no_solid() {
        let of_outline = |corners: &[[f64; 2]]| {
            let mut record = cup();
            let outline = heapless::Vec::from_slice(corners).unwrap();
            record.shape = Shape::Prism { outline, height: 0.09 };
            record.validate()
        };
        let a = 0.04;
        let square = [[-a, -a], [a, -a], [a, a], [-a, a]];
        assert_eq!(of_outline(&square), Ok(()));
        // A corner within an edge does no harm; a notch neither.
        assert_eq!(of_outline(&[[-a, -a], [0.0, -a], [a, -a], [a, a], [-a, a]]), Ok(()));
        assert_eq!(of_outline(&[[-a, -a], [a, -a], [a, a], [0.0, 0.0], [-a, a]]), Ok(()));
        let refused = Err(Invalid::Degenerate("shape.outline"));
        for outline in [
            // Crossing itself, a corner twice, touching itself, running back on itself.
            &[[-a, -a], [a, -a], [a, a], [-a, 0.0], [0.0, -0.03], [-a, a]][..],
            &[[-a, -a], [a, -a], [a, -a], [a, a], [-a, a]],
            &[[-a, -a], [a, -a], [a, a], [0.0, -a], [-a, a]],
            &[[-a, -a], [a, -a], [a, a], [a, 0.0], [-a, a]],
        ] {
            assert_eq!(of_outline(outline), refused, "{outline:?}");
        }
        let of_corners = |corners: &[[f64; 3]]| {
            let mut record = cup();
            record.shape = Shape::Convex { vertices: heapless::Vec::from_slice(corners).unwrap() };
            record.validate()
        };
        let (b, h) = (-0.045, 0.045);
        let solid = [[-a, -a, b], [a, -a, b], [a, a, h], [-a, a, b]];
        assert_eq!(of_corners(&solid), Ok(()));
        let flat = Err(Invalid::Degenerate("shape.vertices"));
        assert_eq!(of_corners(&[[-a, -a, b], [a, -a, b], [a, a, h], [-a, a, h]]), flat);
        assert_eq!(of_corners(&[[-a, -a, b], [a, a, h], [0.0; 3], [0.01, 0.01, 0.01125]]), flat);
    }
}
