//! Pictures, cameras and joints.

use super::std_msgs::Header;

crate::message::messages! {
    "sensor_msgs";

    /// A picture of plain pixels.
    #[derive(Eq, Default)]
    Image {
        /// Start of the exposure of the first row; optical frame.
        header: Header,
        /// Rows.
        height: u32,
        /// Columns.
        width: u32,
        /// Meaning of the bytes, such as `mono8`.
        encoding: String,
        /// 1 when numbers of several bytes are big endian.
        is_bigendian: u8,
        /// Bytes from one row to the next.
        step: u32,
        /// Rows, one after another.
        data: Vec<u8>,
    }

    /// A picture in a file format.
    #[derive(Eq, Default)]
    CompressedImage {
        /// As in [`Image`].
        header: Header,
        /// `jpeg` or `png`, sometimes with more words.
        format: String,
        /// The file's bytes.
        data: Vec<u8>,
    }

    /// Part of a picture (px); all zero for the whole picture.
    #[derive(Copy, Eq, Default)]
    RegionOfInterest {
        /// Leftmost column.
        x_offset: u32,
        /// Topmost row.
        y_offset: u32,
        /// Rows.
        height: u32,
        /// Columns.
        width: u32,
        /// Rectified part differs from the raw one.
        do_rectify: bool,
    }

    /// The model of a camera (px), as ROS's camera calibration writes it.
    #[derive(Default)]
    CameraInfo {
        /// Stamp of the picture; optical frame.
        header: Header,
        /// Rows.
        height: u32,
        /// Columns.
        width: u32,
        /// `plumb_bob`: five coefficients k1, k2, p1, p2, k3.
        distortion_model: String,
        /// Distortion coefficients.
        d: Vec<f64>,
        /// Camera matrix, row-major 3x3.
        k: [f64; 9],
        /// Rectification, row-major 3x3.
        r: [f64; 9],
        /// Projection of the rectified picture, row-major 3x4.
        p: [f64; 12],
        /// Columns merged into one; 0 means 1.
        binning_x: u32,
        /// Rows merged into one; 0 means 1.
        binning_y: u32,
        /// Part of the sensor that the picture shows.
        roi: RegionOfInterest,
    }

    /// Joint positions (rad or m), speeds and efforts; an empty list says nothing.
    #[derive(Default)]
    JointState {
        /// When the encoders were read.
        header: Header,
        /// Joint names as in the URDF.
        name: Vec<String>,
        /// Positions.
        position: Vec<f64>,
        /// Speeds.
        velocity: Vec<f64>,
        /// Efforts (N m or N).
        effort: Vec<f64>,
    }
}
