//! A pose set on disk: BOP multi-sensor layout with two grey cameras and the tags' records.
//!
//! Read are `scene_camera_*.json`, `scene_tags.json` and the pictures; the truth
//! (`scene_gt_left.json`) only where answers are compared with it. A scene may hold several images, and an
//! image several tags: each tag in each image is a case of its own. Simulated scenes are written in the same
//! layout, for other recognisers. Lengths on disk are millimetres, here metres.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, Point3, Rotation3, UnitQuaternion, Vector3};
use rayon::prelude::*;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use vergence_geometry::{Camera, Distortion, GaussianPoint, Transform};
use vergence_imaging::{Image, codec};
use vergence_pose::{Query, View};
use vergence_sim::StereoScene;
use vergence_tag::{Record, Shown};

use crate::failure::Failure;
use crate::save::{cannot_write, unwritten};

const MM: f64 = 1e-3;
const LAYOUT_HINT: &str = "docs/pose.md describes the layout of a pose set";
/// The cameras; the right one may be missing.
const SIDES: [&str; 2] = ["left", "right"];
/// Number of the object of a simulated scene.
const OBJECT: u32 = 1;
/// Most by which a number of `cam_K` that must be zero or one may be off: rounding.
const K_ROUNDING: f64 = 1e-9;

/// Most scenes worked on at the same time: more than any processor has cores, and as many threads as any
/// system starts.
pub const MOST_THREADS: i64 = 1024;

/// One tag in one image: what is to be recognised.
pub struct Case<'a> {
    /// The scene's number.
    pub scene: u32,
    /// The image's number in the scene.
    pub image: u32,
    /// Which of the image's tags it is, from 0.
    pub position: usize,
    /// Nothing comes before it in its scene.
    pub first: bool,
    tag: &'a TagEntry,
    pictures: &'a [Picture],
    truths: Option<&'a [TruthEntry]>,
    folder: &'a Path,
}

/// What a set is read for.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// To answer.
    Answers,
    /// To compare answers with the truth.
    Comparison,
}

/// What came of the cases of a set.
pub struct Worked<T> {
    /// Of those that could be worked on, in order.
    pub results: Vec<T>,
    /// Scenes of the set.
    pub scenes: usize,
    /// Scenes that could not be read, or not in all of their images, with the first reason.
    pub bad: BTreeMap<u32, Failure>,
}

/// A scene's JSON files, by image; the pictures are read one image at a time.
struct Scene {
    number: u32,
    folder: PathBuf,
    cameras: Vec<(&'static str, BTreeMap<u32, CameraEntry>)>,
    tags: BTreeMap<u32, Vec<TagEntry>>,
    truths: Option<BTreeMap<u32, Vec<TruthEntry>>>,
}

struct Picture {
    image: Image<u8>,
    camera: Camera,
    base_from_optical: Transform,
    turn_sd: f64,
    pans: bool,
}

#[derive(Deserialize, Serialize)]
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
    /// Written for others.
    #[serde(skip_deserializing)]
    tilt: Option<f64>,
    /// How well the camera's angles are known (rad); exactly when absent.
    #[serde(default)]
    turn_sd: f64,
}

#[derive(Deserialize, Serialize)]
struct TagEntry {
    obj_id: u32,
    landmark_w: [f64; 3],
    landmark_cov_w: [f64; 9],
    tag: Record,
    standing: Option<bool>,
}

#[derive(Deserialize, Serialize)]
#[allow(non_snake_case)]
struct TruthEntry {
    obj_id: u32,
    cam_R_m2c: [f64; 9],
    cam_t_m2c: [f64; 3],
}

/// Works on every case of a set, as many scenes at a time as there are threads. What cannot be read is told
/// on standard error and stops nothing else.
pub fn each<T: Send>(
    set: &Path,
    threads: u16,
    purpose: Purpose,
    work: impl Fn(&Case) -> Result<T, Failure> + Sync,
) -> Result<Worked<T>, Failure> {
    let folders = folders(set)?;
    let of_scene = |(number, folder): &(u32, PathBuf)| {
        let cases = match Scene::read(*number, folder, purpose) {
            Ok(scene) => scene.each(&work),
            Err(failure) => vec![Err(failure)],
        };
        for failure in cases.iter().filter_map(|case| case.as_ref().err()) {
            eprintln!("scene {number}: {}", failure.message);
        }
        cases
    };
    let all: Vec<Vec<Result<T, Failure>>> =
        pool(threads)?.install(|| folders.par_iter().map(of_scene).collect());
    let mut worked = Worked { results: Vec::new(), scenes: folders.len(), bad: BTreeMap::new() };
    for ((number, _), cases) in folders.iter().zip(all) {
        for case in cases {
            match case {
                Ok(result) => worked.results.push(result),
                Err(failure) => drop(worked.bad.entry(*number).or_insert(failure)),
            }
        }
    }
    Ok(worked)
}

impl<T> Worked<T> {
    /// What ends the command when its results are told: an error when a scene was bad.
    pub fn whole(&self) -> Result<(), Failure> {
        let Some(first) = self.bad.values().next() else { return Ok(()) };
        let (bad, scenes) = (self.bad.len(), self.scenes);
        let message = format!("{bad} of {scenes} scenes could not be read whole, as told above");
        Err(Failure { message, hint: LAYOUT_HINT.into(), status: first.status })
    }
}

/// Threads for as many scenes at a time.
pub fn pool(threads: u16) -> Result<rayon::ThreadPool, Failure> {
    let builder = rayon::ThreadPoolBuilder::new().num_threads(threads.into());
    builder.build().map_err(|e| Failure::failed(e, "ask for fewer --threads"))
}

/// Scene folders of a set with their numbers, in order.
fn folders(set: &Path) -> Result<Vec<(u32, PathBuf)>, Failure> {
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
    /// Reads the JSON files of a scene's folder; without a right camera there is one picture an image.
    fn read(number: u32, folder: &Path, purpose: Purpose) -> Result<Self, Failure> {
        let path = folder.join("scene_tags.json");
        let mut tags: BTreeMap<u32, Vec<TagEntry>> = by_image(&path)?;
        tags.retain(|_, tags| !tags.is_empty());
        if tags.is_empty() {
            return Err(bad(&path, "names no tag"));
        }
        let mut cameras = Vec::new();
        for side in SIDES {
            let path = camera_path(folder, side);
            if side == SIDES[0] || path.exists() {
                cameras.push((side, by_image(&path)?));
            }
        }
        let truths = (purpose == Purpose::Comparison).then(|| by_image(&truth_path(folder)));
        Ok(Scene { number, folder: folder.into(), cameras, tags, truths: truths.transpose()? })
    }

    /// Works on the scene's cases; of an image that cannot be read there is one failure.
    fn each<T>(&self, work: impl Fn(&Case) -> Result<T, Failure>) -> Vec<Result<T, Failure>> {
        let mut results = Vec::new();
        let first_image = self.tags.keys().next();
        for (image, tags) in &self.tags {
            let cameras = self.cameras.iter();
            let pictures: Result<Vec<Picture>, Failure> = cameras
                .map(|(side, entries)| Picture::read(&self.folder, side, *image, entries))
                .collect();
            let pictures = match pictures {
                Ok(pictures) => pictures,
                Err(failure) => {
                    results.push(Err(failure));
                    continue;
                }
            };
            let truths = self.truths.as_ref();
            let truths = truths.map(|t| t.get(image).map_or(&[][..], Vec::as_slice));
            results.extend(tags.iter().enumerate().map(|(position, tag)| {
                work(&Case {
                    scene: self.number,
                    image: *image,
                    position,
                    first: position == 0 && Some(image) == first_image,
                    tag,
                    pictures: &pictures,
                    truths,
                    folder: &self.folder,
                })
            }));
        }
        results
    }
}

impl Case<'_> {
    /// The object's number in the set.
    pub fn object(&self) -> u32 {
        self.tag.obj_id
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
        let tag = self.tag;
        let gravity_known = tag.standing.is_some() || self.pictures.iter().any(|p| p.pans);
        Query {
            record: &tag.tag,
            landmark: GaussianPoint {
                position: Point3::from(Vector3::from(tag.landmark_w) * MM),
                covariance: Matrix3::from_row_slice(&tag.landmark_cov_w) * (MM * MM),
            },
            landmark_index: 0,
            up: gravity_known.then(Vector3::z_axis),
            standing: tag.standing,
        }
    }

    /// `base_from_object` in truth. Of several objects of the tag's number it is the one whose landmark lies
    /// nearest to the tag's.
    pub fn truth(&self) -> Result<Transform, Failure> {
        let path = truth_path(self.folder);
        let mine = |truth: &&TruthEntry| truth.obj_id == self.object();
        let poses: Result<Vec<Transform>, Failure> = self
            .truths
            .unwrap_or_default()
            .iter()
            .filter(mine)
            .map(|truth| {
                let left_from_object =
                    rigid(&truth.cam_R_m2c, &truth.cam_t_m2c).ok_or_else(|| {
                        bad(&path, "cam_R_m2c is not a rotation, or cam_t_m2c not finite")
                    })?;
                Ok(self.pictures[0].base_from_optical * left_from_object)
            })
            .collect();
        let query = self.query();
        let on_object = query
            .record
            .landmarks
            .first()
            .map_or(Point3::origin(), |landmark| Point3::from(landmark.position));
        let off = |pose: &Transform| (pose * on_object - query.landmark.position).norm();
        poses?.into_iter().min_by(|a, b| off(a).total_cmp(&off(b))).ok_or_else(|| {
            bad(&path, format!("names no object {} in image {}", self.object(), self.image))
        })
    }
}

impl Picture {
    /// Reads one camera's picture of an image.
    fn read(
        folder: &Path,
        side: &str,
        image: u32,
        entries: &BTreeMap<u32, CameraEntry>,
    ) -> Result<Self, Failure> {
        let path = camera_path(folder, side);
        let refused = |what: &dyn std::fmt::Display| bad(&path, format!("image {image}: {what}"));
        let entry = entries.get(&image).ok_or_else(|| refused(&"is not there"))?;
        let image_path = picture_path(folder, side, image);
        let image = std::fs::read(&image_path)
            .map_err(|e| bad(&image_path, e))
            .and_then(|bytes| codec::decode(&bytes).map_err(|e| bad(&image_path, e)))?;
        let [fx, skew, cx, skew_y, fy, cy, last @ ..] = entry.cam_K;
        if [skew, skew_y].iter().any(|v| v.abs() > K_ROUNDING) {
            return Err(refused(&"cam_K has a skew, which the camera's model does not know"));
        }
        if last.iter().zip([0.0, 0.0, 1.0]).any(|(v, want)| (v - want).abs() > K_ROUNDING) {
            return Err(refused(&"the last row of cam_K is not 0 0 1"));
        }
        if entry.turn_sd < 0.0 {
            return Err(refused(&"turn_sd is negative"));
        }
        let [k1, k2, p1, p2, k3] = entry.cam_dist.unwrap_or_default();
        let camera = Camera {
            width: image.width(),
            height: image.height(),
            fx,
            fy,
            cx,
            cy,
            distortion: Distortion { k1, k2, p1, p2, k3 },
        };
        camera.validate().map_err(|e| refused(&e))?;
        let optical_from_base = rigid(&entry.cam_R_w2c, &entry.cam_t_w2c)
            .ok_or_else(|| refused(&"cam_R_w2c is not a rotation, or cam_t_w2c not finite"))?;
        Ok(Picture {
            image,
            camera,
            base_from_optical: optical_from_base.inverse(),
            turn_sd: entry.turn_sd,
            pans: entry.pan.is_some(),
        })
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

/// A pose as BOP writes it, to millimetres.
fn rows(pose: &Transform) -> ([f64; 9], [f64; 3]) {
    let by_rows = pose.rotation.to_rotation_matrix().matrix().transpose();
    let translation = pose.translation.vector / MM;
    (std::array::from_fn(|k| by_rows[k]), translation.into())
}

/// Writes a simulated scene with its truth as the scene of this number. A scene of that number that is
/// there already is not touched.
pub fn write(set: &Path, number: u64, scene: &StereoScene) -> Result<(), Failure> {
    let test = set.join("test");
    let folder = test.join(format!("{number:06}"));
    std::fs::create_dir_all(&test).map_err(|e| cannot_write(&test, e))?;
    std::fs::create_dir(&folder).map_err(|e| cannot_write(&folder, e))?;
    let optical_from_base = scene.base_from_optical.map(|pose| pose.inverse());
    for (k, side) in SIDES.into_iter().enumerate() {
        let path = picture_path(&folder, side, 0);
        std::fs::create_dir(folder.join(pictures(side))).map_err(|e| cannot_write(&path, e))?;
        codec::write_png(&path, &scene.images[k]).map_err(unwritten)?;
        let Camera { fx, fy, cx, cy, distortion: Distortion { k1, k2, p1, p2, k3 }, .. } =
            scene.cameras[k];
        let (rotation, translation_mm) = rows(&optical_from_base[k]);
        let ahead = scene.base_from_optical[k].rotation * Vector3::z();
        let camera = CameraEntry {
            cam_K: [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
            cam_R_w2c: rotation,
            cam_t_w2c: translation_mm,
            cam_dist: Some([k1, k2, p1, p2, k3]),
            pan: Some(ahead.y.atan2(ahead.x)),
            tilt: Some(-ahead.z.asin()),
            turn_sd: 0.0,
        };
        write_image(&camera_path(&folder, side), &camera)?;
    }
    let (rotation, translation_mm) = rows(&(optical_from_base[0] * scene.base_from_object));
    let truth = TruthEntry { obj_id: OBJECT, cam_R_m2c: rotation, cam_t_m2c: translation_mm };
    write_image(&truth_path(&folder), &[truth])?;
    let landmark = &scene.landmark;
    let tag = TagEntry {
        obj_id: OBJECT,
        landmark_w: (landmark.position.coords / MM).into(),
        landmark_cov_w: std::array::from_fn(|k| landmark.covariance[k] / (MM * MM)),
        tag: scene.record.clone(),
        standing: None,
    };
    write_image(&folder.join("scene_tags.json"), &[tag])
}

/// A JSON file of BOP about the scene's one image.
fn write_image(path: &Path, entry: &(impl Serialize + ?Sized)) -> Result<(), Failure> {
    let text = serde_json::to_vec_pretty(&BTreeMap::from([("0", entry)]));
    let written = text.map_err(Into::into).and_then(|text| std::fs::write(path, text));
    written.map_err(|error| cannot_write(path, error))
}

fn camera_path(folder: &Path, side: &str) -> PathBuf {
    folder.join(format!("scene_camera_{side}.json"))
}

fn truth_path(folder: &Path) -> PathBuf {
    folder.join("scene_gt_left.json")
}

/// The folder of a camera's pictures in a scene's.
fn pictures(side: &str) -> String {
    format!("gray_{side}")
}

/// BOP names pictures by six digits; PNG is usual, JPEG is read too.
fn picture_path(folder: &Path, side: &str, image: u32) -> PathBuf {
    let stem = folder.join(pictures(side)).join(format!("{image:06}"));
    let candidates = ["png", "jpg", "jpeg"].map(|e| stem.with_extension(e));
    candidates.iter().find(|p| p.exists()).unwrap_or(&candidates[0]).clone()
}

/// A JSON file of BOP: its keys are the images' numbers, which have another order than their text.
fn by_image<T: DeserializeOwned>(path: &Path) -> Result<BTreeMap<u32, T>, Failure> {
    let text = std::fs::read(path).map_err(|e| bad(path, e))?;
    let all: BTreeMap<String, T> = serde_json::from_slice(&text).map_err(|e| bad(path, e))?;
    let mut numbered = BTreeMap::new();
    for (key, value) in all {
        let number = key.parse().ok();
        let new = number.is_some_and(|number| numbered.insert(number, value).is_none());
        if !new {
            let key = Shown(&key);
            return Err(bad(path, format!("\"{key}\" is no image number, or stands there twice")));
        }
    }
    Ok(numbered)
}

fn bad(path: &Path, what: impl std::fmt::Display) -> Failure {
    Failure::misuse(format!("{}: {what}", path.display()), LAYOUT_HINT)
}
