//! Keeps other websites out.
//!
//! A browser that shows somebody else's page can be made to call this address. With tokens such a page has
//! none, but a server on one machine may ask for no tokens. So a request that a browser made for another
//! site is refused, by the headers that only browsers set and pages cannot change.
//!
//! Without tokens, the name in `Host` must be of this machine as well. Otherwise a page could give its own
//! name our address (DNS rebinding), and would be the same site.

use std::net::IpAddr;

use http::header::{self, HeaderMap, HeaderName};
use http::uri::Authority;

const FETCH_SITE: HeaderName = HeaderName::from_static("sec-fetch-site");
const FETCH_MODE: HeaderName = HeaderName::from_static("sec-fetch-mode");
const FETCH_DEST: HeaderName = HeaderName::from_static("sec-fetch-dest");

/// Why a request is refused.
#[derive(Debug, thiserror::Error)]
pub enum Refused {
    /// Its headers contradict each other or cannot be read.
    #[error("{0}")]
    Malformed(String),
    /// Another website made it, or can have made it.
    #[error("{0}")]
    OtherSite(String),
}

/// Refuses a request that another website can have made. `named` is the authority of the request's address,
/// which HTTP/2 has instead of `Host`.
///
/// # Errors
/// When it is refused.
pub fn check(headers: &HeaderMap, named: Option<&Authority>, asks_for_tokens: bool) -> Result<(), Refused> {
    let host: Authority = match named {
        Some(named) => named.clone(),
        None => only(headers, &header::HOST)?
            .and_then(|host| host.parse().ok())
            .ok_or_else(|| Refused::Malformed("Host is missing or is no name with a port".to_owned()))?,
    };
    if !asks_for_tokens && !is_of_this_machine(host.host()) {
        return Err(Refused::OtherSite(format!(
            "{:?} is no address: a server without tokens is reached by an IP address or as localhost",
            host.host()
        )));
    }
    if let Some(origin) = only(headers, &header::ORIGIN)? {
        let same = origin.split_once("://").is_some_and(|(scheme, of)| {
            let port = if scheme.eq_ignore_ascii_case("https") { 443 } else { 80 };
            let of = of.parse::<Authority>();
            of.is_ok_and(|of| place(&of, port) == place(&host, port))
        });
        if !same {
            let message = format!("{origin:?} may not use this address; open the page of {host} itself");
            return Err(Refused::OtherSite(message));
        }
    }
    // A link to a page here may be on any other page. What it opens replaces that page, which learns nothing.
    let is_link =
        only(headers, &FETCH_MODE)? == Some("navigate") && only(headers, &FETCH_DEST)? == Some("document");
    match only(headers, &FETCH_SITE)? {
        Some("cross-site" | "same-site") if !is_link => {
            Err(Refused::OtherSite("another website made this request".to_owned()))
        }
        _ => Ok(()),
    }
}

/// The only value of a header; several contradict each other.
fn only<'a>(headers: &'a HeaderMap, name: &HeaderName) -> Result<Option<&'a str>, Refused> {
    let mut values = headers.get_all(name).iter();
    let value = values.next().map(|value| value.to_str());
    match (value, values.next()) {
        (None, _) => Ok(None),
        (Some(Ok(value)), None) => Ok(Some(value)),
        _ => Err(Refused::Malformed(format!("{name} is there twice or is no text"))),
    }
}

/// Name and port; `port` where none is written.
fn place(of: &Authority, port: u16) -> (String, u16) {
    (of.host().to_ascii_lowercase(), of.port_u16().unwrap_or(port))
}

/// Whether a name leads to this machine wherever it is resolved: an address, or localhost.
fn is_of_this_machine(host: &str) -> bool {
    let bare = host.trim_start_matches('[').trim_end_matches(']');
    bare.parse::<IpAddr>().is_ok() || host.eq_ignore_ascii_case("localhost")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn passes(asks_for_tokens: bool, pairs: &[(&HeaderName, &'static str)]) -> bool {
        let mut headers = HeaderMap::new();
        for (name, value) in pairs {
            headers.append(*name, http::HeaderValue::from_static(value));
        }
        check(&headers, None, asks_for_tokens).is_ok()
    }

    #[test]
    fn without_tokens_only_addresses_of_this_machine_are_named() {
        let passes = |host| passes(false, &[(&header::HOST, host)]);
        assert!(
            passes("127.0.0.1:7480") && passes("[::1]:7480") && passes("LocalHost") && passes("192.168.0.7")
        );
        assert!(
            !passes("wreck.example:7480") && !passes("127.0.0.1.example") && !passes("localhost.example")
        );
        assert!(!passes("") && !passes("a b"));
        let with_tokens = self::passes(true, &[(&header::HOST, "wreck.example")]);
        assert!(with_tokens && !self::passes(true, &[]));
    }

    #[test]
    fn the_origin_is_the_host_with_its_port() {
        let passes = |host, origin| passes(true, &[(&header::HOST, host), (&header::ORIGIN, origin)]);
        assert!(passes("a.example:7480", "http://a.example:7480"));
        assert!(passes("a.example", "https://A.example") && passes("a.example", "https://a.example:443"));
        assert!(passes("a.example:80", "http://a.example"), "a browser leaves the usual port out");
        for other in
            ["http://b.example:7480", "http://a.example:1", "http://a.example", "null", "", "a.example:7480"]
        {
            assert!(!passes("a.example:7480", other), "{other:?}");
        }
    }

    #[test]
    fn a_request_of_another_site_is_refused() {
        let of = |site| passes(true, &[(&header::HOST, "a.example"), (&FETCH_SITE, site)]);
        assert!(of("same-origin") && of("none"));
        assert!(!of("cross-site") && !of("same-site"));
        let opened = |kind, more: &[(&HeaderName, &'static str)]| {
            let link = [
                (&header::HOST, "a.example"),
                (&FETCH_SITE, "cross-site"),
                (&FETCH_MODE, "navigate"),
                (&FETCH_DEST, kind),
            ];
            passes(true, &[&link, more].concat())
        };
        assert!(opened("document", &[]), "a link on another page");
        assert!(!opened("iframe", &[]) && !opened("document", &[(&header::ORIGIN, "http://b.example")]));
    }

    #[test]
    fn a_header_that_is_there_twice_is_refused() {
        let host = (&header::HOST, "a.example");
        assert!(!passes(true, &[host, host]));
        let origin = (&header::ORIGIN, "http://a.example");
        assert!(passes(true, &[host, origin]) && !passes(true, &[host, origin, origin]));
    }
}
