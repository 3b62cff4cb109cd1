//! Generated types of the lanemap wire protocol (lanemap.v1).
