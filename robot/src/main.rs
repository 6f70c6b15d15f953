//! Entry point of the `robot` process.
fn main() {}
