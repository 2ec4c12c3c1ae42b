//! What the arm did, as JSON, for a second physics engine to judge.
