//! A gate in front of the XML parser.
//!
//! The parser walks the tree by recursion, so a document nested deeply enough overflows the stack, which nothing can
//! catch. The gate therefore measures the nesting first, and refuses everything whose end two lexers could see in
//! different places: CDATA, DOCTYPE, processing instructions, `<` and `>` in attribute values.

/// Deepest nesting of elements; a URDF needs five.
const MAX_DEPTH: usize = 24;
/// White space as XML defines it.
const SPACE: [char; 4] = [' ', '\t', '\r', '\n'];

/// Checks that `text` is plain XML of elements, attributes and comments, nested at most [`MAX_DEPTH`] deep.
pub(super) fn check_plain(text: &str) -> Result<(), String> {
    let mut rest = text.trim_start_matches('\u{feff}').trim_start_matches(SPACE);
    if let Some(declaration) = rest.strip_prefix("<?xml") {
        rest = match declaration.split_once('>') {
            Some((body, rest)) if body.strip_suffix('?').is_some_and(|body| !body.contains(['?', '<'])) => rest,
            _ => return Err("the xml declaration does not end in '?>'".to_owned()),
        };
    }
    let mut depth = 0_usize;
    while let Some((_, tag)) = rest.split_once('<') {
        let line = || 1 + text[..text.len() - tag.len()].matches('\n').count();
        if let Some(comment) = tag.strip_prefix("!--") {
            rest = match comment.split_once("--") {
                Some((_, end)) if end.starts_with('>') => &end[1..],
                _ => return Err(format!("line {}: the comment does not end, or has '--' inside", line())),
            };
            continue;
        }
        let Some((body, after)) = tag.split_once('>') else {
            return Err(format!("line {}: the tag does not end in '>'", line()));
        };
        rest = after;
        if let Some(name) = body.strip_prefix('/') {
            if !is_name(name.trim_end_matches(SPACE)) {
                return Err(format!("line {}: malformed end tag </{}>", line(), brief(name)));
            }
            depth = depth.saturating_sub(1);
            continue;
        }
        let open = body.strip_suffix('/');
        if !is_start_tag(open.unwrap_or(body)) {
            return Err(format!(
                "line {}: <{}> is not a plain element: write name=\"value\" pairs, '<' and '>' in values as &lt; and \
                 &gt;, and no CDATA, DOCTYPE or processing instructions",
                line(),
                brief(body)
            ));
        }
        if depth == MAX_DEPTH {
            return Err(format!("line {}: elements are nested more than {MAX_DEPTH} deep", line()));
        }
        depth += usize::from(open.is_none());
    }
    Ok(())
}

/// Text of the file, shortened for a message.
pub(super) fn brief(text: &str) -> String {
    const LONGEST: usize = 200;
    match text.char_indices().nth(LONGEST) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text.to_owned(),
    }
}

fn is_name(name: &str) -> bool {
    name.starts_with(|c: char| c.is_alphabetic() || c == '_')
        && name.chars().all(|c| c.is_alphanumeric() || "_-.:".contains(c))
}

fn is_start_tag(body: &str) -> bool {
    let (name, mut rest) = body.split_at(body.find(SPACE).unwrap_or(body.len()));
    if !is_name(name) || body.contains('<') {
        return false;
    }
    loop {
        rest = rest.trim_start_matches(SPACE);
        if rest.is_empty() {
            return true;
        }
        let Some((attribute, value)) = rest.split_once('=') else {
            return false;
        };
        let value = value.trim_start_matches(SPACE);
        let Some(quote) = value.chars().next().filter(|c| matches!(c, '"' | '\'')) else {
            return false;
        };
        let Some((_, after)) = value[1..].split_once(quote) else {
            return false;
        };
        if !is_name(attribute.trim_end_matches(SPACE)) {
            return false;
        }
        rest = after;
    }
}
