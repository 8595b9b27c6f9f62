//! The page in one file: `web/dist/handover.html` with a scene, a model and photographs inside.
//!
//! It opens from a disk, without a network. Text that is put in cannot become markup: the title is escaped,
//! the scene is JSON without `<`, files are base64. The page's own policy forbids any other script.

use std::io::{Error, Read, Result, Write};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use flate2::read::GzDecoder;

use crate::Dist;

/// The title of the page as it was built.
const TITLE: &str = "<title>Fathom</title>";
/// Where the scene goes.
const SCENE: &str = "<!--fathom:scene-->";
/// Bytes that are encoded at a time; a multiple of 3, so that there is no padding between them.
const PIECE: u64 = 3 << 16;
/// Pieces of one element. Browsers hold at most 512 MB in one text.
const PIECES: u64 = 256;

/// The page as it was built, without a scene.
///
/// # Errors
/// When the build of this program has no such page, or it is damaged.
pub fn handover_template() -> Result<String> {
    let packed = Dist::get("handover.html.gz")
        .ok_or_else(|| Error::other("this build has no handover.html; run scripts/web.sh build"))?;
    let mut html = String::new();
    GzDecoder::new(packed.data.as_ref()).read_to_string(&mut html)?;
    Ok(html)
}

/// A page that is being written.
pub struct Handover<W: Write> {
    sink: W,
    /// The page after the scene.
    rest: String,
}

impl<W: Write> Handover<W> {
    /// Begins a page with its title and the JSON of its scene (`web/README.md`).
    ///
    /// # Errors
    /// When the sink fails, or as [`handover_template`].
    pub fn begin(mut sink: W, title: &str, scene: &str) -> Result<Self> {
        let html = handover_template()?;
        let parts = html.split_once(TITLE).and_then(|(head, rest)| {
            let (body, rest) = rest.split_once(SCENE)?;
            Some((head, body, rest))
        });
        let (head, body, rest) =
            parts.ok_or_else(|| Error::other("handover.html has no place for a scene; build it again"))?;
        write!(sink, "{head}<title>{} - Fathom</title>{body}", escaped(title))?;
        // In JSON, `<` is only inside of strings, where this means the same.
        let scene = scene.replace('<', "\\u003c");
        writeln!(sink, "<script type=\"application/json\" id=\"scene\">{scene}</script>")?;
        Ok(Self { sink, rest: rest.to_owned() })
    }

    /// Adds a file under the path by which the scene names it. Returns its bytes.
    ///
    /// # Errors
    /// When it cannot be read, or the sink fails.
    pub fn file(&mut self, path: &str, mut content: impl Read) -> Result<u64> {
        let mut bytes = 0;
        for number in 0.. {
            let mut piece = Vec::new();
            content.by_ref().take(PIECE).read_to_end(&mut piece)?;
            if number % PIECES == 0 && (number == 0 || !piece.is_empty()) {
                let end = if number == 0 { "" } else { "</script>\n" };
                let path = escaped(path);
                write!(
                    self.sink,
                    "{end}<script type=\"application/octet-stream;base64\" data-file=\"{path}\">"
                )?;
            }
            if piece.is_empty() {
                break;
            }
            bytes += piece.len() as u64;
            self.sink.write_all(STANDARD.encode(&piece).as_bytes())?;
        }
        writeln!(self.sink, "</script>")?;
        Ok(bytes)
    }

    /// Ends the page.
    ///
    /// # Errors
    /// When the sink fails.
    pub fn finish(mut self) -> Result<W> {
        self.sink.write_all(self.rest.as_bytes())?;
        Ok(self.sink)
    }
}

/// Text as text of HTML, also inside of an attribute in quotes.
fn escaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out += "&amp;",
            '<' => out += "&lt;",
            '>' => out += "&gt;",
            '"' => out += "&quot;",
            '\'' => out += "&#39;",
            c => out.push(c),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_holds_what_was_put_in_and_nothing_of_it_is_markup() {
        let title = "</title><script>alert(1)</script>&\"'";
        let scene = r#"{"name":"</script><script>alert(2)</script><!--"}"#;
        let mut page = Handover::begin(Vec::new(), title, scene).unwrap();
        // Two elements: their parts end at a multiple of 3.
        let model: Vec<u8> = (0..PIECE * PIECES + 5).map(|i| (i % 253) as u8).collect();
        assert_eq!(page.file("model.ply", model.as_slice()).unwrap(), model.len() as u64);
        assert_eq!(page.file("a\"><b>.png", &b""[..]).unwrap(), 0);
        let html = String::from_utf8(page.finish().unwrap()).unwrap();
        let template = handover_template().unwrap();
        assert!(!html.contains("alert(1)</script>") && !html.contains("alert(2)</script>"));
        let count = |text: &str, of: &str| text.matches(of).count();
        // The scene, two parts of the model, and the empty file.
        assert_eq!(count(&html, "</script"), count(&template, "</script") + 4);
        assert_eq!(count(&html, "<!--"), count(&template, "<!--") - 1);
        let after =
            |text: &str| html.split_once(text).unwrap().1.split_once("</script>").unwrap().0.to_owned();
        let json: String = after("id=\"scene\">").replace("\\u003c", "<");
        assert_eq!(json, scene);
        let parts: Vec<u8> = html
            .split("data-file=\"model.ply\">")
            .skip(1)
            .flat_map(|part| STANDARD.decode(part.split_once("</script>").unwrap().0).unwrap())
            .collect();
        assert!(parts == model);
        assert!(html.contains("data-file=\"a&quot;&gt;&lt;b&gt;.png\"></script>"));
        assert!(
            html.contains(
                "<title>&lt;/title&gt;&lt;script&gt;alert(1)&lt;/script&gt;&amp;&quot;&#39; - Fathom"
            )
        );
    }

    #[test]
    fn the_page_allows_only_its_own_script_and_style() {
        let html = handover_template().unwrap();
        let policy = html.split_once("content-security-policy\" content=\"").unwrap().1;
        let policy = policy.split_once('"').unwrap().0;
        assert!(policy.starts_with("default-src 'none'; script-src 'sha256-"), "{policy}");
        assert!(!policy.contains("unsafe") && !policy.contains("http"), "{policy}");
        // The policy comes before what it is for.
        assert!(html.find("content-security-policy").unwrap() < html.find("<script").unwrap());
        assert_eq!((html.matches("<script").count(), html.matches("<style").count()), (1, 1));
        assert!(!html.contains("src=\"") && !html.contains("href=\""), "it names other files");
    }
}
