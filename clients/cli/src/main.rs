//! The `lanemap` command: serve, replay, evaluate, simulate, demo.

fn main() {}
