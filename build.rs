//! Compiles `proto/` into Rust (no `protoc` needed) and gathers the built page of `web/`. Only the service has
//! either.

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("cargo:rerun-if-changed=proto");
    println!("cargo:rerun-if-changed=build.rs");
    #[cfg(feature = "service")]
    {
        let schema = protox::compile(["service.proto"], ["proto"])?;
        prost_build::Config::new().compile_fds(schema)?;
        page::gather()?;
    }
    Ok(())
}

#[cfg(feature = "service")]
mod page {
    use std::fmt::Write;
    use std::path::{Path, PathBuf};
    use std::{env, fs, io};

    /// Where `npm run build` puts the page.
    const BUILT: &str = "web/dist";
    /// What is shown where nobody has built it.
    const MISSING: &str = "src/api/page.html";

    /// Writes the table of the page's files: path below `/`, media type, bytes.
    pub fn gather() -> io::Result<()> {
        let root = PathBuf::from(env::var_os("CARGO_MANIFEST_DIR").unwrap_or_default());
        let mut files = vec![];
        if root.join(BUILT).join("index.html").exists() {
            println!("cargo:rerun-if-changed={BUILT}");
            // Tells the tests that there is a page to test.
            println!("cargo:rustc-env=GAKP_PAGE=built");
            list(&root.join(BUILT), &mut files)?;
        } else {
            // Cargo would run this anew each time for a path that is not there.
            println!("cargo:rerun-if-changed=web");
            println!("cargo:rerun-if-changed={MISSING}");
            files.push(root.join(MISSING));
        }
        files.sort();
        let mut table = String::from("&[\n");
        for file in &files {
            let below =
                file.strip_prefix(root.join(BUILT)).ok().and_then(Path::to_str).unwrap_or("index.html");
            let path =
                if below == "index.html" { "/".to_owned() } else { format!("/{}", below.replace('\\', "/")) };
            let media = media_type(file)?;
            writeln!(table, "    ({path:?}, {media:?}, include_bytes!({file:?})),")
                .map_err(io::Error::other)?;
        }
        table.push(']');
        fs::write(PathBuf::from(env::var_os("OUT_DIR").unwrap_or_default()).join("page.rs"), table)
    }

    fn list(folder: &Path, files: &mut Vec<PathBuf>) -> io::Result<()> {
        for entry in fs::read_dir(folder)? {
            let path = entry?.path();
            if path.is_dir() { list(&path, files)? } else { files.push(path) }
        }
        Ok(())
    }

    fn media_type(file: &Path) -> io::Result<&'static str> {
        Ok(match file.extension().and_then(|e| e.to_str()) {
            Some("html") => "text/html; charset=utf-8",
            Some("css") => "text/css; charset=utf-8",
            Some("js") => "text/javascript; charset=utf-8",
            Some("svg") => "image/svg+xml",
            _ => {
                return Err(io::Error::other(format!(
                    "{}: build.rs knows no media type for it",
                    file.display()
                )));
            }
        })
    }
}
