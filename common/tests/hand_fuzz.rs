//! Damaged URDFs and descriptions are refused or loaded, never a panic, and what loads computes finite numbers.

use proptest::prelude::*;
use proptest::sample::Index;
use teleop_common::hand::{HandModel, HandSide, TipFrame, allegro_v4_texts};

/// What the mutations insert: pieces of syntax, numbers no hand has, names that exist elsewhere.
const SNIPPETS: [&str; 34] = [
    "<",
    ">",
    "/>",
    "\"",
    "'",
    "&",
    "&lt;",
    "&#0;",
    "&bogus;",
    "<!--",
    "-->",
    "<![CDATA[]]]]>",
    "<!DOCTYPE a>",
    "<?a b?>",
    "<a b>c=\"",
    "</link>",
    "</robot>",
    "<link name=\"palm_link\"/>",
    " xmlns=\"u\"",
    " xmlns:p=\"u\" p:a=\"\"",
    "p:",
    "NaN",
    "-inf",
    "1e309",
    "-1",
    "0",
    "[",
    "]",
    "{",
    "}",
    "=",
    "\n",
    "\u{0}",
    "\u{1F590}",
];

#[derive(Clone, Debug)]
enum Mutation {
    Delete(Index, u8),
    Repeat(Index, u8),
    Insert(Index, usize),
    /// Swaps the text between two quotes for that between two others.
    Swap(Index, Index),
}

fn mutation() -> impl Strategy<Value = Mutation> {
    prop_oneof![
        (any::<Index>(), any::<u8>()).prop_map(|(at, length)| Mutation::Delete(at, length)),
        (any::<Index>(), any::<u8>()).prop_map(|(at, length)| Mutation::Repeat(at, length)),
        (any::<Index>(), 0..SNIPPETS.len()).prop_map(|(at, snippet)| Mutation::Insert(at, snippet)),
        (any::<Index>(), any::<Index>()).prop_map(|(a, b)| Mutation::Swap(a, b)),
    ]
}

fn mutate(text: &str, mutations: &[Mutation]) -> String {
    let mut chars: Vec<char> = text.chars().collect();
    for mutation in mutations {
        if chars.is_empty() {
            break;
        }
        let range = |at: &Index, length: u8| {
            let start = at.index(chars.len());
            start..(start + usize::from(length)).min(chars.len())
        };
        match mutation {
            Mutation::Delete(at, length) => drop(chars.drain(range(at, *length))),
            Mutation::Repeat(at, length) => {
                let range = range(at, *length);
                let copy: Vec<char> = chars[range.clone()].to_vec();
                chars.splice(range.start..range.start, copy);
            }
            Mutation::Insert(at, snippet) => {
                let at = at.index(chars.len());
                chars.splice(at..at, SNIPPETS[*snippet].chars());
            }
            Mutation::Swap(a, b) => {
                let text: String = chars.iter().collect();
                let mut parts: Vec<&str> = text.split('"').collect();
                let values = parts.len() / 2;
                if values > 0 {
                    parts.swap(2 * a.index(values) + 1, 2 * b.index(values) + 1);
                }
                chars = parts.join("\"").chars().collect();
            }
        }
    }
    chars.into_iter().collect()
}

/// Loads, and computes with whatever loads.
fn exercise(urdf: &str, description: &str) -> Result<(), TestCaseError> {
    let hand = match HandModel::load(urdf, description) {
        Ok(hand) => hand,
        Err(error) => {
            let message = error.to_string();
            prop_assert!(!message.is_empty() && message.len() < 4096, "{message}");
            return Ok(());
        }
    };
    let home = hand.home();
    prop_assert_eq!(hand.clip(&home), home);
    let mut poses = Vec::new();
    hand.link_poses(&home, &mut poses);
    prop_assert!(poses.iter().all(|pose| pose.translation.vector.iter().all(|value| value.is_finite())));
    for chain in &hand.fingers {
        let (tip, jacobian) = chain.tip_and_jacobian(&chain.select(&home), TipFrame::Pole);
        prop_assert!(tip.iter().chain(jacobian.iter()).all(|value| value.is_finite()));
    }
    for map in &hand.joint_maps {
        prop_assert!(map.apply(&[1.0; 20]).is_finite());
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, cases: 192, ..ProptestConfig::default() })]

    #[test]
    fn damaged_urdf(mutations in prop::collection::vec(mutation(), 1..5), left: bool) {
        let (urdf, description) = allegro_v4_texts(if left { HandSide::Left } else { HandSide::Right });
        exercise(&mutate(urdf, &mutations), description)?;
    }

    #[test]
    fn damaged_description(mutations in prop::collection::vec(mutation(), 1..5), left: bool) {
        let (urdf, description) = allegro_v4_texts(if left { HandSide::Left } else { HandSide::Right });
        exercise(urdf, &mutate(description, &mutations))?;
    }

    #[test]
    fn arbitrary_text(urdf in "\\PC{0,200}", description in "\\PC{0,200}") {
        let (good_urdf, good_description) = allegro_v4_texts(HandSide::Right);
        prop_assert!(HandModel::load(&urdf, good_description).is_err());
        prop_assert!(HandModel::load(good_urdf, &description).is_err());
    }

    /// Documents of markup alone, where a parser's states are reached fastest.
    #[test]
    fn arbitrary_markup(pieces in prop::collection::vec(0..SNIPPETS.len(), 0..40)) {
        let markup: String = pieces.iter().map(|piece| SNIPPETS[*piece]).collect();
        let (urdf, description) = allegro_v4_texts(HandSide::Right);
        let inside = format!("<robot name=\"a\">{markup}</robot>");
        prop_assert!(HandModel::load(&markup, description).is_err());
        prop_assert!(HandModel::load(&inside, description).is_err());
        prop_assert!(HandModel::load(urdf, &markup).is_err());
    }
}
