//! Entry point of the `operator` process.
fn main() {}
