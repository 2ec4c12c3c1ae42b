//! A head as the tests need it: the one that the evaluation describes.

use crate::PanTiltHead;
use crate::evaluation::described_head;

/// Left or right head of the test robot; `y` is the place of its pan axis in base.
pub(crate) fn head(y: f64) -> PanTiltHead {
    described_head(y)
}

/// Both heads.
pub(crate) fn heads() -> [PanTiltHead; 2] {
    [head(0.1), head(-0.1)]
}
