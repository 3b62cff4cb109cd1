//! The lanemap viewer: a page and its scripts, embedded at build time.
//!
//! The page asks the server that served it what changed, draws its vector tiles with MapLibre, and asks nothing of any other
//! host. Its files stand in `page/`; MapLibre and the typeface come from npm while the crate is built (see `build.rs`).
//!
//! ```
//! let page = lanemap_web::asset("index.html").unwrap();
//! assert_eq!(page.content_type, "text/html; charset=utf-8");
//! ```

/// One file of the viewer.
#[derive(Clone, Copy, Debug)]
pub struct Asset {
    /// Name beside the page, without a folder.
    pub name: &'static str,
    /// Its media type, with the character set where it is text.
    pub content_type: &'static str,
    /// Hash of the bytes, hexadecimal: the same bytes have the same digest within one build of the crate.
    pub digest: &'static str,
    /// The file itself.
    pub bytes: &'static [u8],
}

/// Every file of the viewer, in the order of its name.
pub const ASSETS: &[Asset] = include!(concat!(env!("OUT_DIR"), "/assets.rs"));

/// The file of a name, or `None` where the viewer has no such file.
#[must_use]
pub fn asset(name: &str) -> Option<&'static Asset> {
    ASSETS.binary_search_by(|asset| asset.name.cmp(name)).ok().map(|index| &ASSETS[index])
}

/// Whether npm installed MapLibre when this crate was built; without it the page lists sessions but draws no map.
#[must_use]
pub fn has_map() -> bool {
    asset("maplibre-gl.mjs").is_some()
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    fn is_own(name: &str) -> bool {
        !name.starts_with("maplibre-gl") && !name.starts_with("inter")
    }

    #[test]
    fn every_asset_is_found_by_its_name_and_is_not_empty() {
        for expected in ASSETS {
            let found = asset(expected.name).unwrap();
            assert_eq!(found.digest, expected.digest);
            assert!(!found.bytes.is_empty(), "{} is empty", found.name);
        }
        assert!(asset("no-such-file.js").is_none());
    }

    #[test]
    fn the_page_names_no_other_host() {
        for asset in ASSETS.iter().filter(|asset| is_own(asset.name)) {
            let text = std::str::from_utf8(asset.bytes).unwrap().replace("http://www.w3.org/2000/svg", "");
            assert!(!text.contains("http://") && !text.contains("https://"), "{} names a host", asset.name);
        }
    }

    #[test]
    fn every_module_that_a_page_file_imports_is_embedded() {
        let is_script = |asset: &&Asset| asset.content_type.starts_with("text/javascript") && is_own(asset.name);
        for asset_file in ASSETS.iter().filter(is_script) {
            let text = std::str::from_utf8(asset_file.bytes).unwrap();
            for line in text.lines().filter(|line| line.starts_with("import ")) {
                let name = line.split('"').nth(1).unwrap().trim_start_matches("./");
                let without_npm = name == "maplibre-gl.mjs" && !has_map();
                assert!(without_npm || asset(name).is_some(), "{} imports {name}", asset_file.name);
            }
        }
    }
}
