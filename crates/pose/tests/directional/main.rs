//! The directional method on rendered scenes with known truth.

mod boxes;
mod scene;
mod shapes;
