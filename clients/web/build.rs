//! Gathers the viewer's files into one table: those of `page/` as they stand, and MapLibre and the typeface Inter as npm
//! installs them.
//!
//! npm writes into `OUT_DIR` only, from the committed lock file. Where npm is missing or fails the crate still builds,
//! with a warning, and the page tells its reader how to get the map drawn.

use std::{
    collections::hash_map::DefaultHasher,
    env,
    error::Error,
    fmt::Write as _,
    fs,
    hash::{Hash, Hasher},
    path::{Path, PathBuf},
    process::Command,
};

/// What the page takes of packages: the name in the folder of packages, and the name beside the page.
const FROM_NPM: [(&str, &str); 6] = [
    ("maplibre-gl/dist/maplibre-gl.mjs", "maplibre-gl.mjs"),
    ("maplibre-gl/dist/maplibre-gl-worker.mjs", "maplibre-gl-worker.mjs"),
    ("maplibre-gl/dist/maplibre-gl.css", "maplibre-gl.css"),
    ("maplibre-gl/LICENSE.txt", "maplibre-gl-license.txt"),
    ("@fontsource-variable/inter/files/inter-latin-wght-normal.woff2", "inter.woff2"),
    ("@fontsource-variable/inter/LICENSE", "inter-license.txt"),
];

/// Settings and lock of npm, copied beside what it installs.
const NPM_INPUTS: [&str; 3] = ["package.json", "package-lock.json", ".npmrc"];

fn main() -> Result<(), Box<dyn Error>> {
    let crate_dir = PathBuf::from(env::var("CARGO_MANIFEST_DIR")?);
    let out_dir = PathBuf::from(env::var("OUT_DIR")?);
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed=page");
    for input in NPM_INPUTS {
        println!("cargo::rerun-if-changed={input}");
    }

    let mut files = page_files(&crate_dir.join("page"))?;
    match install(&crate_dir, &out_dir.join("npm")) {
        Ok(installed) => files.extend(installed),
        Err(reason) => {
            println!(
                "cargo::warning=the viewer is built without its map, for MapLibre could not be installed: {reason}"
            );
            // A path that never exists: npm is asked again at the next build.
            println!("cargo::rerun-if-changed={}", out_dir.join("ask-npm-again").display());
        }
    }
    files.sort();
    fs::write(out_dir.join("assets.rs"), table(&files)?)?;
    Ok(())
}

/// A file's name beside the page, and where it lies.
type File = (String, PathBuf);

fn page_files(page: &Path) -> Result<Vec<File>, Box<dyn Error>> {
    fs::read_dir(page)?
        .map(|entry| {
            let entry = entry?;
            Ok((entry.file_name().to_string_lossy().into_owned(), entry.path()))
        })
        .collect()
}

fn install(crate_dir: &Path, npm_dir: &Path) -> Result<Vec<File>, Box<dyn Error>> {
    fs::create_dir_all(npm_dir)?;
    for input in NPM_INPUTS {
        fs::copy(crate_dir.join(input), npm_dir.join(input))?;
    }
    let npm = if cfg!(windows) { "npm.cmd" } else { "npm" };
    let output = Command::new(npm)
        .args(["ci", "--ignore-scripts", "--prefer-offline", "--fetch-timeout=60000", "--loglevel=error"])
        .current_dir(npm_dir)
        .output()
        .map_err(|error| format!("npm does not run: {error}"))?;
    if !output.status.success() {
        let complaint = String::from_utf8_lossy(&output.stderr);
        return Err(format!("npm ci failed: {}", complaint.lines().next().unwrap_or("no reason given")).into());
    }
    let packages = npm_dir.join("node_modules");
    FROM_NPM
        .into_iter()
        .map(|(inside, name)| {
            let path = packages.join(inside);
            fs::metadata(&path).map_err(|error| format!("{inside}: {error}"))?;
            Ok((name.to_owned(), path))
        })
        .collect()
}

/// The source of the table: one `Asset` per file, sorted by name.
fn table(files: &[File]) -> Result<String, Box<dyn Error>> {
    let mut source = String::from("&[\n");
    for (name, path) in files {
        let mut hasher = DefaultHasher::new();
        fs::read(path)?.hash(&mut hasher);
        let path = path.to_str().ok_or("the build folder's name is not UTF-8")?;
        writeln!(
            source,
            "    Asset {{ name: {name:?}, content_type: {:?}, digest: \"{:016x}\", bytes: include_bytes!({path:?}) }},",
            content_type(name)?,
            hasher.finish(),
        )?;
    }
    source.push_str("]\n");
    Ok(source)
}

fn content_type(name: &str) -> Result<&'static str, String> {
    match name.rsplit('.').next() {
        Some("html") => Ok("text/html; charset=utf-8"),
        Some("css") => Ok("text/css; charset=utf-8"),
        Some("js" | "mjs") => Ok("text/javascript; charset=utf-8"),
        Some("svg") => Ok("image/svg+xml"),
        Some("woff2") => Ok("font/woff2"),
        Some("txt") => Ok("text/plain; charset=utf-8"),
        _ => Err(format!("page/{name} has no known content type")),
    }
}
