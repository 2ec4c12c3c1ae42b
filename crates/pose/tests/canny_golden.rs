//! Our Canny against OpenCV's, bit for bit, on a noisy picture with edges in every direction.
//!
//! The golden files come from `scripts/make_canny_golden.py`, which calls `cv2.Canny`.

use vergence_imaging::codec;
use vergence_pose::canny::canny;

#[test]
fn canny_is_bit_equal_to_opencv() {
    let picture = codec::decode(include_bytes!("data/canny_input.png")).unwrap();
    let golden: [(i32, i32, &[u8]); 2] = [
        (40, 100, include_bytes!("data/canny_40_100.png")),
        (90, 200, include_bytes!("data/canny_90_200.png")),
    ];
    for (low, high, bytes) in golden {
        let expected = codec::decode(bytes).unwrap();
        let edges = canny(&picture, low, high);
        assert!(expected.data().contains(&255));
        let different = edges.data().iter().zip(expected.data()).filter(|(a, b)| a != b).count();
        assert_eq!(different, 0, "pixels that differ at thresholds {low}, {high}");
    }
}
