//! Time of a stereo pair: with the head at rest, and with the head moving.
fn main() {
    divan::main();
}
