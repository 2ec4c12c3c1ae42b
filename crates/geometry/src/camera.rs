//! Pinhole camera with Brown-Conrady distortion: points in an optical frame to pixels and back.
//!
//! The model is that of ROS `sensor_msgs/CameraInfo` (`plumb_bob`) and OpenCV: with
//! `x = X/Z, y = Y/Z, r2 = x^2 + y^2`,
//!
//! ```text
//! x' = x (1 + k1 r2 + k2 r2^2 + k3 r2^3) + 2 p1 x y + p2 (r2 + 2 x^2)
//! y' = y (1 + k1 r2 + k2 r2^2 + k3 r2^3) + p1 (r2 + 2 y^2) + 2 p2 x y
//! u  = fx x' + cx,   v = fy y' + cy
//! ```

use nalgebra::{Matrix2, Matrix2x3, Matrix3, Point2, Point3, Vector3};

/// Brown-Conrady coefficients (dimensionless), zero by default.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Distortion {
    /// Radial, r^2.
    pub k1: f64,
    /// Radial, r^4.
    pub k2: f64,
    /// Tangential.
    pub p1: f64,
    /// Tangential.
    pub p2: f64,
    /// Radial, r^6.
    pub k3: f64,
}

impl Distortion {
    /// True when every coefficient is zero.
    pub fn is_none(&self) -> bool {
        *self == Distortion::default()
    }
}

/// Why a camera's numbers were refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CameraError {
    /// Focal length or principal point is not a usable number.
    #[error(
        "camera {field} = {value} is not usable: it must be finite, and a focal length positive"
    )]
    BadNumber {
        /// Which number.
        field: &'static str,
        /// What it was.
        value: f64,
    },
    /// The picture has no pixels, or more than anyone has (2^14 a side).
    #[error("picture size {width}x{height} is not usable")]
    BadSize {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
}

/// Intrinsic parameters of one camera; pixels, pixel (0, 0) is the centre of the top-left pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Columns of the picture.
    pub width: usize,
    /// Rows of the picture.
    pub height: usize,
    /// Focal length along u in pixels.
    pub fx: f64,
    /// Focal length along v in pixels.
    pub fy: f64,
    /// Principal point, column.
    pub cx: f64,
    /// Principal point, row.
    pub cy: f64,
    /// Lens distortion.
    pub distortion: Distortion,
}

impl Camera {
    /// A distortion-free camera with square pixels and the principal point in the picture's middle.
    pub fn centred(width: usize, height: usize, focal_px: f64) -> Self {
        Camera {
            width,
            height,
            fx: focal_px,
            fy: focal_px,
            cx: (width as f64 - 1.0) / 2.0,
            cy: (height as f64 - 1.0) / 2.0,
            distortion: Distortion::default(),
        }
    }

    /// Checks numbers that came from outside.
    pub fn validate(&self) -> Result<(), CameraError> {
        let (width, height) = (self.width, self.height);
        if !(1..=1 << 14).contains(&width) || !(1..=1 << 14).contains(&height) {
            return Err(CameraError::BadSize { width, height });
        }
        let d = &self.distortion;
        let numbers = [
            ("fx", self.fx, true),
            ("fy", self.fy, true),
            ("cx", self.cx, false),
            ("cy", self.cy, false),
            ("k1", d.k1, false),
            ("k2", d.k2, false),
            ("p1", d.p1, false),
            ("p2", d.p2, false),
            ("k3", d.k3, false),
        ];
        for (field, value, positive) in numbers {
            if !value.is_finite() || (positive && value <= 0.0) {
                return Err(CameraError::BadNumber { field, value });
            }
        }
        Ok(())
    }

    /// Distorted normalised coordinates of undistorted ones.
    pub fn distort(&self, x: f64, y: f64) -> (f64, f64) {
        let d = &self.distortion;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (d.k1 + r2 * (d.k2 + r2 * d.k3));
        (
            x * radial + 2.0 * d.p1 * x * y + d.p2 * (r2 + 2.0 * x * x),
            y * radial + d.p1 * (r2 + 2.0 * y * y) + 2.0 * d.p2 * x * y,
        )
    }

    /// Derivative of [`Camera::distort`].
    fn distort_jacobian(&self, x: f64, y: f64) -> Matrix2<f64> {
        let d = &self.distortion;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (d.k1 + r2 * (d.k2 + r2 * d.k3));
        let slope = 2.0 * (d.k1 + r2 * (2.0 * d.k2 + 3.0 * r2 * d.k3));
        let cross = x * y * slope + 2.0 * d.p1 * x + 2.0 * d.p2 * y;
        Matrix2::new(
            radial + x * x * slope + 2.0 * d.p1 * y + 6.0 * d.p2 * x,
            cross,
            cross,
            radial + y * y * slope + 6.0 * d.p1 * y + 2.0 * d.p2 * x,
        )
    }

    /// Whether the radial distortion grows all the way out to an undistorted normalised place. Further
    /// out the polynomial folds back and puts what is far outside of the picture into it.
    pub fn is_one_to_one(&self, x: f64, y: f64) -> bool {
        let d = &self.distortion;
        let r2 = x * x + y * y;
        // Mostly its terms together are too small to turn it, which costs little to see.
        let terms = r2 * (3.0 * d.k1.abs() + r2 * (5.0 * d.k2.abs() + r2 * 7.0 * d.k3.abs()));
        if terms < 1.0 {
            return true;
        }
        // Derivative of r (1 + k1 r^2 + k2 r^4 + k3 r^6) by r, and where it is the least over r^2.
        let grows = |s: f64| 1.0 + s * (3.0 * d.k1 + s * (5.0 * d.k2 + s * 7.0 * d.k3)) > 0.0;
        let (a, b, c) = (21.0 * d.k3, 10.0 * d.k2, 3.0 * d.k1);
        // Both roots without a difference of nearly equal numbers. What is not a number is no such place.
        let q = -0.5 * (b + (b * b - 4.0 * a * c).sqrt().copysign(b));
        let turns = [q / a, c / q];
        grows(r2) && turns.into_iter().all(|s| !(s > 0.0 && s < r2) || grows(s))
    }

    /// Pixel of a point in the optical frame (metres); `None` behind or on the camera plane, and
    /// further out than the lens's model holds ([`Camera::is_one_to_one`]).
    pub fn project(&self, p_optical: &Point3<f64>) -> Option<Point2<f64>> {
        if p_optical.z <= 1e-9 {
            return None;
        }
        let (x, y) = (p_optical.x / p_optical.z, p_optical.y / p_optical.z);
        if !self.distortion.is_none() && !self.is_one_to_one(x, y) {
            return None;
        }
        let (x, y) = self.distort(x, y);
        Some(Point2::new(self.fx * x + self.cx, self.fy * y + self.cy))
    }

    /// Pixel of a point and its derivative by the point (pixels per metre).
    pub fn project_with_jacobian(
        &self,
        p_optical: &Point3<f64>,
    ) -> Option<(Point2<f64>, Matrix2x3<f64>)> {
        let pixel = self.project(p_optical)?;
        let iz = 1.0 / p_optical.z;
        let (x, y) = (p_optical.x * iz, p_optical.y * iz);
        let pinhole = Matrix2x3::new(iz, 0.0, -x * iz, 0.0, iz, -y * iz);
        let scale = Matrix2::new(self.fx, 0.0, 0.0, self.fy);
        Some((pixel, scale * self.distort_jacobian(x, y) * pinhole))
    }

    /// Unit direction in the optical frame that a pixel sees.
    ///
    /// Newton's method on the distortion; exact without distortion. Far outside the picture of a
    /// strongly distorting lens, where the model is not invertible, the best iterate is returned.
    pub fn unproject(&self, pixel: &Point2<f64>) -> Vector3<f64> {
        let (xd, yd) = ((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy);
        let (mut x, mut y) = (xd, yd);
        if !self.distortion.is_none() {
            for _ in 0..12 {
                let (u, v) = self.distort(x, y);
                let residual = nalgebra::Vector2::new(xd - u, yd - v);
                let Some(inverse) = self.distort_jacobian(x, y).try_inverse() else { break };
                let step = inverse * residual;
                (x, y) = (x + step.x, y + step.y);
                if step.norm_squared() < 1e-24 {
                    break;
                }
            }
        }
        Vector3::new(x, y, 1.0).normalize()
    }

    /// True when the pixel lies within the picture, `margin_px` away from its border.
    pub fn contains(&self, pixel: &Point2<f64>, margin_px: f64) -> bool {
        let inside = |value: f64, size: usize| {
            value >= margin_px - 0.5 && value <= size as f64 - 0.5 - margin_px
        };
        inside(pixel.x, self.width) && inside(pixel.y, self.height)
    }

    /// The 3x3 camera matrix K.
    pub fn matrix(&self) -> Matrix3<f64> {
        Matrix3::new(self.fx, 0.0, self.cx, 0.0, self.fy, self.cy, 0.0, 0.0, 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn lens() -> Camera {
        let distortion = Distortion { k1: -0.28, k2: 0.07, p1: 0.001, p2: -0.0007, k3: 0.0 };
        Camera { distortion, ..Camera::centred(640, 480, 520.0) }
    }

    proptest! {
        #[test]
        fn unproject_inverts_project(x in -0.5f64..0.5, y in -0.4f64..0.4, z in 0.2f64..3.0) {
            let p = Point3::new(x * z, y * z, z);
            let pixel = lens().project(&p).unwrap();
            let d = lens().unproject(&pixel);
            prop_assert!((d - p.coords.normalize()).norm() < 1e-9, "{d} against {p}");
        }

        #[test]
        fn jacobian_equals_finite_differences(x in -0.4f64..0.4, y in -0.3f64..0.3, z in 0.3f64..2.0) {
            let p = Point3::new(x, y, z);
            let (_, jacobian) = lens().project_with_jacobian(&p).unwrap();
            for k in 0..3 {
                let mut step = Vector3::zeros();
                step[k] = 1e-6;
                let numeric = (lens().project(&(p + step)).unwrap() - lens().project(&(p - step)).unwrap()) / 2e-6;
                prop_assert!((numeric - jacobian.column(k)).norm() < 1e-4 * (1.0 + numeric.norm()));
            }
        }
    }

    #[test]
    fn behind_the_camera_is_no_pixel() {
        assert!(lens().project(&Point3::new(0.1, 0.1, -1.0)).is_none());
        assert!(lens().project(&Point3::new(0.1, 0.1, 0.0)).is_none());
    }

    #[test]
    fn what_the_lens_folds_back_is_no_pixel() {
        // One that falls for good, one that grows again further out, two that never fold.
        for (k1, k2, k3, folds) in [
            (-0.3, 0.0, 0.0, true),
            (-0.6, 0.1, 0.0, true),
            (-0.3, 0.1, -0.02, true),
            (-0.6, 0.1, 1e-18, true),
            (-0.28, 0.07, 0.0, false),
            (0.1, 0.0, 5.0, false),
        ] {
            let distortion = Distortion { k1, k2, k3, ..Distortion::default() };
            let camera = Camera { distortion, ..lens() };
            let at = |k: i32| camera.project(&Point3::new(0.01 * f64::from(k), 0.0, 1.0));
            let pixels: Vec<Option<f64>> = (0..500).map(|k| at(k).map(|p| p.x)).collect();
            let seen = pixels.iter().take_while(|p| p.is_some()).count();
            assert_eq!(seen < 500, folds);
            assert!(pixels[..seen].windows(2).all(|w| w[0] < w[1]));
            assert!(pixels[seen..].iter().all(Option::is_none));
            assert!(seen > 50);
        }
    }

    #[test]
    fn bad_numbers_are_named() {
        let camera = Camera { fx: f64::NAN, ..lens() };
        assert!(matches!(camera.validate(), Err(CameraError::BadNumber { field: "fx", .. })));
        assert!(Camera { width: 0, ..lens() }.validate().is_err());
        assert!(lens().validate().is_ok());
    }
}
