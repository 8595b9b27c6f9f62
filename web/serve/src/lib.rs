//! The pages for browsers: `web/dist` as it was built and committed, inside the program.
//!
//! Files are compressed with gzip, which every browser accepts over plain HTTP too. They are sent as they
//! are. A client that does not accept gzip gets them decompressed.

mod handover;
mod same_site;

use std::io::Read as _;

use bytes::Bytes;
use flate2::read::GzDecoder;
use http::header::{self, HeaderMap, HeaderName, HeaderValue};
use http::{Response, StatusCode};
use rust_embed::Embed;

pub use handover::{Handover, handover_template};
pub use same_site::{Refused, check};

#[derive(Embed)]
#[folder = "../dist"]
struct Dist;

/// What a page may do: run the scripts that came with it, and fetch from where it came from. Nothing else is
/// fetched, so it works offline, and text in it cannot become a script.
pub const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; \
                          connect-src 'self'; worker-src 'self'; base-uri 'none'; form-action 'none'; \
                          frame-ancestors 'none'";

/// A file of the pages by its path below `web/dist`, such as `view.html`, as the answer to a request with
/// these headers; `None` if there is none.
pub fn page(path: &str, asked: &HeaderMap) -> Option<Response<Bytes>> {
    // It is a form for `Handover`, not a page of a server.
    let packed = Dist::get(&format!("{path}.gz")).filter(|_| path != "handover.html")?.data;
    let accepts =
        asked.get(header::ACCEPT_ENCODING).and_then(|value| value.to_str().ok()).unwrap_or_default();
    let as_it_is = accepts.split(',').any(|word| word.trim().split(';').next() == Some("gzip"));
    let content = if as_it_is {
        Bytes::from(packed.into_owned())
    } else {
        let mut content = Vec::new();
        // What was compressed for the build can be decompressed; the tests read every file.
        GzDecoder::new(packed.as_ref()).read_to_end(&mut content).ok()?;
        content.into()
    };
    let mut answer = Response::new(content);
    *answer.status_mut() = StatusCode::OK;
    let headers = answer.headers_mut();
    if as_it_is {
        headers.insert(header::CONTENT_ENCODING, HeaderValue::from_static("gzip"));
    }
    headers.insert(header::VARY, HeaderValue::from_static("accept-encoding"));
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(kind_of(path)));
    // Names of assets change with their content.
    let kept = if path.starts_with("assets/") { "public, max-age=31536000, immutable" } else { "no-cache" };
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static(kept));
    for (name, value) in [
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    Some(answer)
}

/// The content type of a file by its name.
pub fn kind_of(path: &str) -> &'static str {
    match path.rsplit('.').next().unwrap_or_default() {
        "html" => "text/html; charset=utf-8",
        "js" => "text/javascript; charset=utf-8",
        "css" => "text/css; charset=utf-8",
        "txt" => "text/plain; charset=utf-8",
        "json" => "application/json",
        "png" => "image/png",
        "jpg" | "jpeg" => "image/jpeg",
        "webp" => "image/webp",
        _ => "application/octet-stream",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_file_is_the_same_with_and_without_gzip() {
        let gzip =
            HeaderMap::from_iter([(header::ACCEPT_ENCODING, HeaderValue::from_static("br, gzip;q=0.5"))]);
        let mut count = 0;
        for name in Dist::iter() {
            let name = name.strip_suffix(".gz").unwrap();
            if name == "handover.html" {
                continue;
            }
            let (packed, plain) = (page(name, &gzip).unwrap(), page(name, &HeaderMap::new()).unwrap());
            assert_eq!(packed.headers()[header::CONTENT_ENCODING], "gzip");
            assert!(!plain.headers().contains_key(header::CONTENT_ENCODING));
            let mut content = Vec::new();
            GzDecoder::new(packed.body().as_ref()).read_to_end(&mut content).unwrap();
            assert_eq!(&content, plain.body(), "{name}");
            assert_ne!(plain.headers()[header::CONTENT_TYPE], "application/octet-stream", "{name}");
            count += 1;
        }
        assert!(count >= 4, "{count} files");
        assert!(page("view.html", &gzip).is_some() && page("../Cargo.toml", &gzip).is_none());
    }

    #[test]
    fn a_page_names_only_scripts_and_styles_that_are_there() {
        for name in ["index.html", "view.html"] {
            let html = page(name, &HeaderMap::new()).unwrap();
            let html = std::str::from_utf8(html.body()).unwrap();
            let named: Vec<_> = html.split('"').filter_map(|word| word.strip_prefix("./")).collect();
            assert!(named.len() >= 2, "{html}");
            for file in named {
                assert!(page(file, &HeaderMap::new()).is_some(), "{name}: {file}");
            }
            assert!(!html.contains("http://") && !html.contains("https://"), "fetched from elsewhere");
        }
    }
}
