//! A pose set on disk: BOP multi-sensor layout with two grey cameras and the tags' records.
//!
//! Read are `scene_camera_*.json`, `scene_tags.json` and the pictures; the truth
//! (`scene_gt_left.json`) only where answers are compared with it. Lengths on disk are millimetres,
//! here metres.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, Point3, Rotation3, UnitQuaternion, Vector3};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use vergence_geometry::{Camera, Distortion, GaussianPoint, Transform};
use vergence_imaging::{Image, codec};
use vergence_pose::{Query, View};
use vergence_tag::Record;

use crate::failure::Failure;

const MM: f64 = 1e-3;
const LAYOUT_HINT: &str = "docs/pose.md describes the layout of a pose set";

/// One scene: pictures, cameras, and what the robot knows.
pub struct Scene {
    /// The object's number in the set.
    pub object: u32,
    pictures: Vec<Picture>,
    record: Record,
    landmark: GaussianPoint,
    standing: Option<bool>,
    gravity_known: bool,
}

struct Picture {
    image: Image<u8>,
    camera: Camera,
    base_from_optical: Transform,
    turn_sd: f64,
}

#[derive(Deserialize)]
#[allow(non_snake_case)]
struct CameraEntry {
    cam_K: [f64; 9],
    cam_R_w2c: [f64; 9],
    cam_t_w2c: [f64; 3],
    /// Brown-Conrady k1, k2, p1, p2, k3, in OpenCV's order.
    #[serde(default)]
    cam_dist: Option<[f64; 5]>,
    /// A camera that pans and tilts stands on a robot, whose base is level.
    pan: Option<f64>,
    /// How well the camera's angles are known (rad); exactly when absent.
    #[serde(default)]
    turn_sd: f64,
}

#[derive(Deserialize)]
struct TagEntry {
    obj_id: u32,
    landmark_w: [f64; 3],
    landmark_cov_w: [f64; 9],
    tag: Record,
    standing: Option<bool>,
}

#[derive(Deserialize)]
#[allow(non_snake_case)]
struct TruthEntry {
    cam_R_m2c: [f64; 9],
    cam_t_m2c: [f64; 3],
}

/// Scene folders of a set with their numbers, in order.
pub fn scenes(set: &Path) -> Result<Vec<(u32, PathBuf)>, Failure> {
    let test = set.join("test");
    let entries = std::fs::read_dir(&test)
        .map_err(|e| Failure::misuse(format!("{}: {e}", test.display()), LAYOUT_HINT))?;
    let mut found: Vec<(u32, PathBuf)> = entries
        .flatten()
        .filter_map(|entry| Some((entry.file_name().to_str()?.parse().ok()?, entry.path())))
        .collect();
    found.sort();
    if found.is_empty() {
        return Err(Failure::misuse(format!("{}: holds no scene", test.display()), LAYOUT_HINT));
    }
    Ok(found)
}

impl Scene {
    /// Reads a scene's folder; a scene without a right camera has one picture.
    pub fn read(folder: &Path) -> Result<Self, Failure> {
        let (image_id, tags): (String, Vec<TagEntry>) = first(&folder.join("scene_tags.json"))?;
        let tag = tags.into_iter().next().ok_or_else(|| {
            bad(&folder.join("scene_tags.json"), "names no tag for its first image")
        })?;
        let mut pictures = vec![Picture::read(folder, "left", &image_id)?];
        let mut gravity_known = pictures[0].1;
        if folder.join("scene_camera_right.json").exists() {
            let right = Picture::read(folder, "right", &image_id)?;
            gravity_known |= right.1;
            pictures.push(right);
        }
        Ok(Scene {
            object: tag.obj_id,
            pictures: pictures.into_iter().map(|(picture, _)| picture).collect(),
            record: tag.tag,
            landmark: GaussianPoint {
                position: Point3::from(Vector3::from(tag.landmark_w) * MM),
                covariance: Matrix3::from_row_slice(&tag.landmark_cov_w) * (MM * MM),
            },
            standing: tag.standing,
            gravity_known: gravity_known || tag.standing.is_some(),
        })
    }

    /// `base_from_object` in truth, of the first object in the left picture.
    pub fn truth(&self, folder: &Path) -> Result<Transform, Failure> {
        let path = folder.join("scene_gt_left.json");
        let (_, objects): (String, Vec<TruthEntry>) = first(&path)?;
        let object = objects.first().ok_or_else(|| bad(&path, "names no object"))?;
        let left_from_object = rigid(&object.cam_R_m2c, &object.cam_t_m2c)
            .ok_or_else(|| bad(&path, "cam_R_m2c is not a rotation, or cam_t_m2c not finite"))?;
        Ok(self.pictures[0].base_from_optical * left_from_object)
    }

    /// The pictures as the recogniser wants them, left first.
    pub fn views(&self) -> Vec<View<'_>> {
        self.pictures
            .iter()
            .map(|p| View {
                image: &p.image,
                camera: p.camera,
                base_from_optical: p.base_from_optical,
                turn_sd: p.turn_sd,
            })
            .collect()
    }

    /// What is looked for.
    pub fn query(&self) -> Query<'_> {
        Query {
            record: &self.record,
            landmark: self.landmark,
            landmark_index: 0,
            up: self.gravity_known.then(Vector3::z_axis),
            standing: self.standing,
        }
    }
}

impl Picture {
    /// Reads one camera and its picture; also whether the camera pans.
    fn read(folder: &Path, side: &str, image_id: &str) -> Result<(Self, bool), Failure> {
        let path = folder.join(format!("scene_camera_{side}.json"));
        let mut cameras: BTreeMap<String, CameraEntry> = json(&path)?;
        let entry = cameras
            .remove(image_id)
            .ok_or_else(|| bad(&path, format!("has no image {image_id}")))?;
        let image_path = picture_path(folder, side, image_id);
        let image = codec::read(&image_path)
            .map_err(|e| Failure::misuse(format!("{}: {e}", image_path.display()), LAYOUT_HINT))?;
        let k = entry.cam_K;
        let [k1, k2, p1, p2, k3] = entry.cam_dist.unwrap_or_default();
        let camera = Camera {
            width: image.width(),
            height: image.height(),
            fx: k[0],
            fy: k[4],
            cx: k[2],
            cy: k[5],
            distortion: Distortion { k1, k2, p1, p2, k3 },
        };
        camera.validate().map_err(|e| bad(&path, e))?;
        let base_from_optical = rigid(&entry.cam_R_w2c, &entry.cam_t_w2c)
            .ok_or_else(|| bad(&path, "cam_R_w2c is not a rotation, or cam_t_w2c not finite"))?;
        let base_from_optical = base_from_optical.inverse();
        let turn_sd = entry.turn_sd.abs();
        Ok((Picture { image, camera, base_from_optical, turn_sd }, entry.pan.is_some()))
    }
}

/// A pose of BOP: a rotation by rows and millimetres.
fn rigid(rotation: &[f64; 9], translation_mm: &[f64; 3]) -> Option<Transform> {
    let r = Matrix3::from_row_slice(rotation);
    let t = Vector3::from(*translation_mm) * MM;
    let sound = (r * r.transpose() - Matrix3::identity()).norm() < 1e-3 && r.determinant() > 0.0;
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(r));
    (sound && t.iter().all(|v| v.is_finite())).then(|| Transform::from_parts(t.into(), rotation))
}

/// BOP names pictures by six digits; PNG is usual, JPEG is read too.
fn picture_path(folder: &Path, side: &str, image_id: &str) -> PathBuf {
    let stem = folder.join(format!("gray_{side}")).join(format!("{image_id:0>6}"));
    let candidates = ["png", "jpg", "jpeg"].map(|e| stem.with_extension(e));
    candidates.iter().find(|p| p.exists()).unwrap_or(&candidates[0]).clone()
}

fn first<T: DeserializeOwned>(path: &Path) -> Result<(String, T), Failure> {
    let all: BTreeMap<String, T> = json(path)?;
    all.into_iter().next().ok_or_else(|| bad(path, "is empty"))
}

fn json<T: DeserializeOwned>(path: &Path) -> Result<T, Failure> {
    let text = std::fs::read(path)
        .map_err(|e| Failure::misuse(format!("{}: {e}", path.display()), LAYOUT_HINT))?;
    serde_json::from_slice(&text).map_err(|e| bad(path, e))
}

fn bad(path: &Path, what: impl std::fmt::Display) -> Failure {
    Failure::misuse(format!("{}: {what}", path.display()), LAYOUT_HINT)
}
