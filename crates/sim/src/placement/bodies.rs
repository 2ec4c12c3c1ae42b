//! The bodies of tagged objects and of untagged things.

use std::sync::Arc;

use nalgebra::{Point3, Translation3, UnitQuaternion, Vector3};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use vergence_geometry::Transform;
use vergence_tag::{LandmarkSite, Shape};

use crate::config::{ObjectSettings, Surface};
use crate::error::SimError;
use crate::faces::faces;
use crate::scene::{Body, Material};
use crate::trace::{Facets, Solid, Texture};

/// Bodies of a tagged object and of the housing of its tag.
pub fn object_bodies(
    settings: &ObjectSettings,
    base_from_object: &Transform,
    housing: bool,
    rng: &mut Pcg64Mcg,
) -> Result<Vec<Body>, SimError> {
    let record = &settings.record;
    let [w, l, h] = record.bounding_box.sides();
    let solid = match &record.shape {
        Shape::Box => Solid::Box([w, l, h].map(|s| 0.5 * s as f32)),
        Shape::Cylinder { diameter, height } => Solid::Frustum {
            bottom: 0.5 * *diameter as f32,
            top: 0.5 * *diameter as f32,
            half: 0.5 * *height as f32,
        },
        Shape::Cup { top_diameter, bottom_diameter, height } => Solid::Cup {
            bottom: 0.5 * *bottom_diameter as f32,
            top: 0.5 * *top_diameter as f32,
            half: 0.5 * *height as f32,
            wall: (0.04 * *top_diameter as f32).clamp(0.0015, 0.005),
        },
        Shape::Sphere { diameter } => Solid::Sphere(0.5 * *diameter as f32),
        Shape::Prism { .. } | Shape::Convex { .. } => {
            let faces = faces(&record.shape);
            let faces = faces.ok_or_else(|| SimError::Shape(record.object_id.to_string()))?;
            Solid::Faceted(Arc::new(Facets::new(&faces)))
        }
    };
    let surface = material(settings.surface, &solid, rng);
    let mut bodies = vec![Body::new(solid, base_from_object, surface)];
    if let (Shape::Cup { top_diameter, bottom_diameter, height }, true) =
        (&record.shape, settings.handle)
    {
        let radius = 0.25 * (top_diameter + bottom_diameter);
        bodies.extend(handle(radius, *height, base_from_object, surface));
    }
    if housing {
        for site in &record.landmarks {
            bodies.push(tag_housing(site, base_from_object));
        }
    }
    Ok(bodies)
}

/// A bow of capsules opposite to the usual place of the landmark.
fn handle(
    radius: f64,
    height: f64,
    base_from_object: &Transform,
    surface: Material,
) -> impl Iterator<Item = Body> {
    let (reach, rise, thick) = (0.3 * height, 0.3 * height, 0.05 * height);
    let plain = Material { texture: Texture::Plain, ..surface };
    let base_from_object = *base_from_object;
    let at = move |k: usize| {
        let angle = std::f64::consts::PI * (k as f64 / 7.0 - 0.5);
        Point3::new(0.0, -radius - reach * angle.cos(), rise * angle.sin())
    };
    (0..7).map(move |k| {
        let (a, b) = (at(k), at(k + 1));
        let turn = UnitQuaternion::rotation_between(&Vector3::z(), &(b - a)).unwrap_or_default();
        let place = Transform::from_parts(Translation3::from(nalgebra::center(&a, &b)), turn);
        let solid = Solid::Capsule { half: 0.5 * (b - a).norm() as f32, radius: thick as f32 };
        Body::new(solid, &(base_from_object * place), plain)
    })
}

/// A dark plate around the LED, just below the emitter's face.
fn tag_housing(site: &LandmarkSite, base_from_object: &Transform) -> Body {
    let normal = Vector3::from(site.normal);
    let turn = UnitQuaternion::rotation_between(&Vector3::z(), &normal).unwrap_or_default();
    // Its outer face lies 0.5 mm behind the emitter, its inner one within the wall.
    let centre = Vector3::from(site.position) - normal * 0.0013;
    let place = Transform::from_parts(Translation3::from(centre), turn);
    let solid = Solid::Frustum { bottom: 0.006, top: 0.006, half: 0.0008 };
    let mut body = Body::new(
        solid,
        &(base_from_object * place),
        Material::matt(0.06, Texture::Plain, 1).glossy(0.02),
    );
    body.shadow = false;
    body
}

/// A surface in a random tone.
pub(super) fn material(surface: Surface, solid: &Solid, rng: &mut Pcg64Mcg) -> Material {
    let seed: u32 = rng.random();
    let albedo = rng.random_range(0.2..0.75f32);
    let (around, height) = match *solid {
        Solid::Frustum { bottom, top, half } | Solid::Cup { bottom, top, half, .. } => {
            (std::f32::consts::PI * (bottom + top), 2.0 * half)
        }
        _ => (0.1, 0.1),
    };
    let texture = match surface {
        Surface::Plain => Texture::Plain,
        Surface::Printed => Texture::Print { size: [0.5 * around, height] },
        Surface::Striped => Texture::Stripes { width: 0.18 * height, ratio: 0.4 },
        Surface::Speckled => Texture::Grain { size: 0.02, contrast: 0.5 },
    };
    Material::matt(albedo, texture, seed).glossy(rng.random_range(0.01..0.05))
}

/// A box, book, can, cone, ball or mug; with the height of its centre and its radius on the table.
pub(super) fn clutter_solid(rng: &mut Pcg64Mcg) -> (Solid, f64, f64) {
    let mut size = |low: f64, high: f64| rng.random_range(low..high);
    let pick = size(0.0, 6.0) as u32;
    match pick {
        0 | 1 => {
            let half = [size(0.02, 0.06), size(0.02, 0.06), size(0.02, 0.08)];
            (Solid::Box(half.map(|h| h as f32)), half[2], half[0].hypot(half[1]))
        }
        2 => {
            let half = [size(0.07, 0.1), size(0.09, 0.13), size(0.008, 0.02)];
            (Solid::Box(half.map(|h| h as f32)), half[2], half[0].hypot(half[1]))
        }
        3 => {
            let (radius, half) = (size(0.025, 0.05), size(0.03, 0.08));
            let r = radius as f32;
            (Solid::Frustum { bottom: r, top: r, half: half as f32 }, half, radius)
        }
        4 => {
            let (radius, half) = (size(0.03, 0.045), size(0.03, 0.06));
            let (top, bottom) = (radius as f32, 0.8 * radius as f32);
            (Solid::Cup { bottom, top, half: half as f32, wall: 0.003 }, half, radius)
        }
        _ => {
            let radius = size(0.025, 0.045);
            (Solid::Sphere(radius as f32), radius, radius)
        }
    }
}
