//! Compiles `proto/` into Rust (no `protoc` needed). Only the service speaks protobuf.

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("cargo:rerun-if-changed=proto");
    println!("cargo:rerun-if-changed=build.rs");
    #[cfg(feature = "service")]
    {
        let schema = protox::compile(["tracks.proto"], ["proto"])?;
        prost_build::Config::new().compile_fds(schema)?;
    }
    Ok(())
}
