//! Sites along a projected contour and the edges found across it.
//!
//! **In:** a pose, the model, a prepared view at one of its levels. **Out:** [`Site`]s: places on
//! the contour with the normal there, how the contour moves across it when the pose changes, and
//! *all* edges near along the normal, to a fraction of a pixel. Print runs parallel to silhouettes
//! and shadows to feet, so the nearest or the strongest edge is often the wrong one; the refinement
//! weighs them all.

use nalgebra::{Matrix3, Point3, RowSVector, RowVector2, Unit, Vector2, Vector3};
use vergence_geometry::Transform;

use super::level::Level;
use super::search::Sight;
use crate::model::{Contour, Kind, Model};

// Deviations of a whole part's edge from where the record has it, on the object (m): the core of
// what was measured at the true poses of rendered, simulated and real scenes (docs/pose.md).
/// Outline where a face ends: rounded edges, seams, bulging sides.
const FORM_SD: f64 = 0.0004;
/// Outline of a curved wall: it darkens towards where it turns away.
const LIMB_SD: f64 = 0.0004;
/// Edge between two visible faces: where a rounded edge seems to be depends on the light.
const CREASE_SD: f64 = 0.0006;
/// Open rim: rolled or rounded lips.
const RIM_SD: f64 = 0.0008;
/// Foot of a standing object: contact shadows hide where it ends.
const CONTACT_SD: f64 = 0.0015;
/// Outline of a wall that turns away below: where it lies, its own shadow begins before it ends.
const BELLY_SD: f64 = 0.004;

/// Most edges kept at a site.
pub const CANDIDATES: usize = 4;
/// A slope counts as an edge from this many noise deviations on.
const NOISE_FACTOR: f32 = 2.1;

/// Deviation of a slope's maximum (px of the level) by noise, at a slope of one noise deviation: the
/// noise of the second derivative against its size at the maximum of a blurred step, whose blur is
/// the lens's, the pixel's and the level's together.
const NOISE_TO_PLACE: f64 = 1.3;

/// Share of a slope's maximum that its neighbours are taken to have at least.
const LEAST_SHOULDER: f32 = 0.02;

/// An edge across the contour.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Candidate {
    /// Offset along the site's normal (picture px).
    pub offset: f64,
    /// Weight, 0 to 1: strength against the strongest edge of the site.
    pub weight: f64,
    /// Deviation of the offset by sensor noise (picture px).
    pub noise_px: f64,
    /// Steepest step between two values across the edge, signed along the normal (grey levels).
    pub slope: f32,
}

/// Unknowns that all views share: the pose's tangent (rad, m), then the [`Form`].
pub const SHARED: usize = FORM_AT + 3;
/// Where the form begins among them.
pub const FORM_AT: usize = 6;
/// Where the lip is among them.
pub const LIP_AT: usize = SHARED - 1;

/// How a site's contour moves across itself by the shared unknowns.
pub type ByShared = RowSVector<f64, SHARED>;

/// How the object differs from its record, in all views alike: the logarithm of its size, how far
/// silhouettes swell outwards (px; blooming, gamma, rounded edges), and how thick the lip of an open
/// rim is (m). Views that swell on their own would shift the object in depth.
pub type Form = Vector3<f64>;

/// A place on the contour.
#[derive(Debug, Clone, PartialEq)]
pub struct Site {
    /// Which view.
    pub view: usize,
    /// Which part of the body the contour lies on there, as in [`crate::Segment`].
    pub part: u16,
    /// How far along the part (m).
    pub along: f64,
    /// What it is.
    pub kind: Kind,
    /// Picture pixel.
    pub pixel: (f64, f64),
    /// Unit normal in the picture.
    pub normal: (f64, f64),
    /// Contour length that the site stands for (picture px).
    pub length: f64,
    /// Size of a metre across the line of sight there (px).
    pub px_per_metre: f64,
    /// The foot of a standing object, or a wall that turns away below: where its shadow begins.
    pub contact: bool,
    /// Shift of the contour along the normal by the shared unknowns (px per unit), the lip's aside.
    pub by_shared: ByShared,
    /// Shift of the lip's inner edge by its thickness (px per m).
    pub by_lip: f64,
    /// Shift by small turns of the camera about its own x and y axes (px per rad).
    pub by_turn: RowVector2<f64>,
    /// Where the inner edge of an open rim would be (px along the normal); the outer is at zero.
    pub inner: Option<f64>,
    /// The edges, `count` of them.
    pub candidates: [Candidate; CANDIDATES],
    /// How many edges.
    pub count: usize,
}

impl Site {
    /// Places (px along the normal) where the contour's edge may be, each as likely: the contour
    /// itself, or the inner edge of a rim's lip.
    pub fn places(&self) -> impl Iterator<Item = (f64, bool)> {
        std::iter::once((0.0, false)).chain(self.inner.map(|inner| (inner, true)))
    }

    /// Deviation of the whole part's edge from where the record has it, on the object (m).
    pub fn offset_sd(&self) -> f64 {
        match (self.contact, self.kind) {
            (true, Kind::Limb) => BELLY_SD,
            (true, _) => CONTACT_SD,
            (false, Kind::Crease) => CREASE_SD,
            (false, Kind::Rim) => RIM_SD,
            (false, Kind::Limb) => LIMB_SD,
            (false, Kind::Silhouette) => FORM_SD,
        }
    }

    /// The edges found.
    pub fn edges(&self) -> &[Candidate] {
        &self.candidates[..self.count]
    }
}

/// How to lay out sites.
#[derive(Debug, Clone, Copy)]
pub struct Layout {
    /// Distance between sites along the contour (picture px).
    pub spacing_px: f64,
    /// Edges are looked for this far to either side (picture px).
    pub range_px: f64,
    /// At full resolution instead of the working scale.
    pub fine: bool,
}

/// What the sites are laid out for.
#[derive(Debug, Clone, Copy)]
pub struct State<'a> {
    /// `base_from_object`.
    pub pose: &'a Transform,
    /// How it differs from its record.
    pub form: Form,
    /// Small turns of the camera about its own x and y axes (rad).
    pub turn: Vector2<f64>,
}

/// Appends the sites of one view.
pub fn sites(
    out: &mut Vec<Site>,
    sight: &Sight,
    view: usize,
    model: &Model,
    state: &State,
    up: Option<Unit<Vector3<f64>>>,
    layout: &Layout,
) {
    let level = if layout.fine { &sight.fine } else { &sight.coarse };
    let pose = state.pose;
    let size = state.form.x.exp();
    let turned = Transform::rotation(state.turn.push(0.0));
    let optical_from_object = turned * sight.optical_from_base * pose;
    let optical_from_base = optical_from_object.rotation * pose.rotation.inverse();
    let optical_from_base: Matrix3<f64> = optical_from_base.to_rotation_matrix().into_inner();
    let eye = optical_from_object.inverse_transform_point(&Point3::origin());
    let mut contour = Contour::new();
    model.contour(&(eye.coords / size), true, &mut contour);
    let camera = &sight.view.camera;
    let Some(middle) = camera.project(&optical_from_object.translation.vector.into()) else {
        return;
    };
    let up_in_object = up.map(|up| pose.rotation.inverse() * up.into_inner());
    let mut profile = Vec::new();
    // Contour since the last site of the part under way: short chords of a curve share one.
    let (mut part, mut since) = (None, 0.0);
    for segment in &contour {
        let [from, to] =
            [segment.from, segment.to].map(|p| optical_from_object * Point3::from(p * size));
        let (Some(a), Some(b)) = (camera.project(&from), camera.project(&to)) else { continue };
        let length = (b - a).norm();
        let here = Some((segment.part, segment.kind));
        if part != here {
            (part, since) = (here, 0.0);
        }
        since += length;
        if since < LEAST_SPACING * layout.spacing_px {
            continue;
        }
        let stands_for = std::mem::take(&mut since);
        let contact = match (segment.away, up_in_object) {
            (Some(away), Some(up)) => {
                let least = if segment.kind == Kind::Limb { BELLY_COS } else { CONTACT_COS };
                away.dot(&up) < -least
            }
            _ => false,
        };
        // A contour that passes close by the camera, or is bent outwards by the lens, may be endless.
        let across = MOST_ACROSS * (camera.width + camera.height) as f64;
        let n = (length.min(across) / layout.spacing_px).round().max(1.0) as usize;
        for k in 0..n {
            let share = (k as f64 + 0.5) / n as f64;
            // A point of the 3D segment, and the line's direction in the picture right there:
            // both true under perspective and distortion.
            let in_object = segment.from.lerp(&segment.to, share) * size;
            let p = optical_from_object * Point3::from(in_object);
            let Some((pixel, by_point)) = camera.project_with_jacobian(&p) else { continue };
            if !camera.contains(&pixel, 1.0) {
                continue;
            }
            let along = by_point * (to - from);
            let Some(along) = along.try_normalize(1e-9) else { continue };
            // The normal points outwards, away from the object's middle.
            let mut normal = nalgebra::RowVector2::new(-along.y, along.x);
            if (normal * (pixel - middle)).x < 0.0 {
                normal = -normal;
            }
            let swells = matches!(segment.kind, Kind::Silhouette | Kind::Limb) && !contact;
            let pixel = if swells { pixel + normal.transpose() * state.form.y } else { pixel };
            let across = normal * by_point;
            let by_base = across * optical_from_base;
            let lever = pose.rotation * in_object;
            // v' (turn x lever) = turn' (lever x v): no matrices.
            let by_rotation = lever.cross(&by_base.transpose()).transpose();
            let by_camera = p.coords.cross(&across.transpose());
            let mut by_shared = ByShared::zeros();
            by_shared.fixed_columns_mut::<3>(0).copy_from(&by_rotation);
            by_shared.fixed_columns_mut::<3>(3).copy_from(&by_base);
            by_shared[FORM_AT] = (by_base * lever).x;
            by_shared[FORM_AT + 1] = if swells { 1.0 } else { 0.0 };
            let towards_axis = -Vector3::new(in_object.x, in_object.y, 0.0);
            let by_lip = match (segment.kind, towards_axis.try_normalize(1e-9)) {
                (Kind::Rim, Some(inwards)) => (by_base * (pose.rotation * inwards)).x,
                _ => 0.0,
            };
            let mut site = Site {
                view,
                part: segment.part,
                along: segment.along + share * (segment.to - segment.from).norm(),
                kind: segment.kind,
                pixel: (pixel.x, pixel.y),
                normal: (normal.x, normal.y),
                length: stands_for / n as f64,
                px_per_metre: camera.fx / p.z,
                contact,
                by_shared,
                by_lip,
                by_turn: RowVector2::new(by_camera.x, by_camera.y),
                inner: (segment.kind == Kind::Rim).then_some(by_lip * state.form.z),
                candidates: Default::default(),
                count: 0,
            };
            find_edges(&mut site, level, layout.range_px, &mut profile);
            out.push(site);
        }
    }
}

/// Length of a line that is followed at the spacing (sides of the picture): what is longer lies mostly
/// outside, and is followed in larger steps.
const MOST_ACROSS: f64 = 3.0;
/// Share of the spacing that sites keep at least.
const LEAST_SPACING: f64 = 0.5;
/// Cosine above which a face that turns away counts as the one that the object rests on.
const CONTACT_COS: f64 = 0.99;
/// The same for a wall that turns away: more of it than the line it rests on is in its shadow.
const BELLY_COS: f64 = 0.4;

/// Local extrema of the slope along the normal. A blurred step's slope is a Gaussian, so a parabola
/// through the logarithms of three samples has its top in the right place; one through the samples
/// themselves is off by up to 0.07 px, with the same sign all along an upright edge.
fn find_edges(site: &mut Site, level: &Level, range_px: f64, profile: &mut Vec<f32>) {
    let scale = level.scale as f64;
    let place = level.from_picture(site.pixel.0, site.pixel.1);
    let crossings = level.across(place, site.normal, range_px / scale, profile);
    // Slopes lie half way between values. Outside the picture: none.
    for k in 0..profile.len() - 1 {
        let slope = profile[k + 1] - profile[k];
        profile[k] = if slope.is_nan() { 0.0 } else { slope };
    }
    profile.pop();
    let step = crossings.step * scale;
    let first = crossings.first * scale + 0.5 * step;
    let threshold = NOISE_FACTOR * level.step_noise;
    let mut strongest = 0.0f32;
    for i in 1..profile.len() - 1 {
        let b = profile[i].abs();
        if b < threshold {
            continue;
        }
        let sign = profile[i].signum();
        let (a, c) = (profile[i - 1] * sign, profile[i + 1] * sign);
        if b <= a || b < c {
            continue;
        }
        let [la, lc] = [a, c].map(|v| (v.max(LEAST_SHOULDER * b) / b).ln());
        let peak = 0.5 * (lc - la) / -(la + lc);
        let offset = first + (i as f64 + f64::from(peak)) * step;
        if offset.abs() > range_px {
            continue;
        }
        let height = b * (0.25 * (lc - la) * peak).exp();
        strongest = strongest.max(height);
        let noise_px = NOISE_TO_PLACE * f64::from(level.step_noise / height) * step;
        let weight = f64::from(height);
        insert(site, Candidate { offset, weight, noise_px, slope: sign * height });
    }
    for candidate in &mut site.candidates[..site.count] {
        candidate.weight = 0.3 + 0.7 * candidate.weight / f64::from(strongest);
    }
}

/// Keeps the strongest.
fn insert(site: &mut Site, candidate: Candidate) {
    if site.count < CANDIDATES {
        site.candidates[site.count] = candidate;
        site.count += 1;
        return;
    }
    let weakest = site.candidates.iter_mut().min_by(|a, b| a.weight.total_cmp(&b.weight));
    if let Some(weakest) = weakest
        && weakest.weight < candidate.weight
    {
        *weakest = candidate;
    }
}

#[cfg(test)]
impl Site {
    /// A place on a silhouette, upright in the picture's middle, without edges.
    pub fn bare() -> Self {
        Site {
            view: 0,
            part: 0,
            along: 0.0,
            kind: Kind::Silhouette,
            pixel: (100.0, 100.0),
            normal: (1.0, 0.0),
            length: 2.0,
            px_per_metre: 1000.0,
            contact: false,
            by_shared: ByShared::zeros(),
            by_lip: 0.0,
            by_turn: RowVector2::zeros(),
            inner: None,
            candidates: Default::default(),
            count: 0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::directional::level::{Reduced, Region};
    use vergence_imaging::Image;

    /// The only edge that is found across a contour at this pixel with this normal.
    fn edge(level: &Level, pixel: (f64, f64), normal: (f64, f64)) -> f64 {
        let mut site = Site { pixel, normal, ..Site::bare() };
        find_edges(&mut site, level, 4.0, &mut Vec::new());
        assert_eq!(site.count, 1, "{:?}", site.edges());
        site.candidates[0].offset
    }

    /// Step of a lens that blurs by half a pixel, averaged over pixels.
    fn step(x: f64) -> f64 {
        let lens = |t: f64| 1.0 / (1.0 + (-t / 0.28).exp());
        (0..8).map(|k| lens(x - 0.4375 + 0.125 * f64::from(k))).sum::<f64>() / 8.0
    }

    #[test]
    fn edges_have_no_bias_wherever_they_lie_between_pixels() {
        let (width, height) = (48, 48);
        let whole = Region { left: 0, top: 0, width, height };
        for (nx, ny) in [(1.0, 0.0), (0.0, -1.0), (0.8, 0.6), (-0.28, 0.96)] {
            for phase in 0..10 {
                // The edge passes the picture's middle at this distance along the normal.
                let shift = 0.1 * f64::from(phase);
                let grey = |x: usize, y: usize| {
                    let along = nx * (x as f64 - 24.0) + ny * (y as f64 - 24.0);
                    (40.0 + 160.0 * step(along - shift)).round() as u8
                };
                let mut image = Image::filled(width, height, 0u8);
                for y in 0..height {
                    image.row_mut(y).iter_mut().enumerate().for_each(|(x, v)| *v = grey(x, y));
                }
                let level = Reduced::new(&image, &whole, 1).smoothed(0.35);
                // Sites along the contour, as a part has them.
                let offsets = (-4..=4).map(|k| {
                    let t = 1.7 * f64::from(k);
                    edge(&level, (24.0 - t * ny, 24.0 + t * nx), (nx, ny)) - shift
                });
                let bias = offsets.sum::<f64>() / 9.0;
                assert!(bias.abs() < 0.03, "normal ({nx}, {ny}), {shift:.1} px: {bias:.3}");
            }
        }
    }
}
