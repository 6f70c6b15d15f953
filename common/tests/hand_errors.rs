//! Every way a URDF or a description can be wrong has an error that names the element.

use teleop_common::hand::{HandError, HandModel, HandSide, Shape, TipFrame, allegro_v4_texts};

fn right() -> (String, String) {
    let (urdf, description) = allegro_v4_texts(HandSide::Right);
    (urdf.to_owned(), description.to_owned())
}

/// Replaces the first `from`, which must be there.
#[track_caller]
fn edit(text: &str, from: &str, to: &str) -> String {
    assert!(text.contains(from), "nothing to replace: {from}");
    text.replacen(from, to, 1)
}

#[track_caller]
fn assert_refused(urdf: &str, description: &str, expected: &str) {
    match HandModel::load(urdf, description) {
        Ok(_) => panic!("loads, but should say: {expected}"),
        Err(error) => assert!(error.to_string().contains(expected), "says: {error}\n  not: {expected}"),
    }
}

const ROLL_3: &str = "<joint name=\"joint_3.0\" type=\"revolute\">";
const ORIGIN_3: &str = "<origin xyz=\"0 0 0.0384\"/>";
const LIMIT_0: &str = "<limit lower=\"-0.47\" upper=\"0.47\" effort=\"0.92\" velocity=\"7\"/>";

#[test]
fn broken_urdf_is_refused_by_name() {
    let (urdf, description) = right();
    let link_0 = "<link name=\"link_0.0\">";
    let cases: &[(&str, &str, &str)] = &[
        // Not XML, not a URDF.
        ("</robot>", "", "urdf:"),
        ("</link>", "</lonk>", "urdf:"),
        ("<robot ", "<robot name=\"again\" ", "urdf: Parse error"),
        ("<robot ", "<robot x ", "urdf: line 22: <robot x name"),
        ("<robot ", "<!DOCTYPE robot>\n<robot ", "urdf: line 22: <!DOCTYPE robot> is not a plain element"),
        ("0 0 0.0082", "0 > 0.0082", "urdf: line"),
        ("<!-- palm -->", "<!-- palm -- >", "the comment does not end, or has '--' inside"),
        ("type=\"revolute\"", "type=\"hinge\"", "urdf: custom: unknown variant `hinge`"),
        ("<parent link=\"palm_link\"/>", "", "missing field `parent`"),
        ("0 0 0.0164", "0 0.0164", "expected 3 found 2 for [0 0.0164]"),
        ("velocity=\"7\"", "velocity=\"fast\"", "invalid float"),
        // Links.
        (link_0, "<link name=\"link_1.0\">", "link 'link_1.0': defined twice"),
        (link_0, "<link name=\"\">", "link '': a name needs 1 to 128 bytes"),
        (link_0, "<link name=\"other\">", "joint 'joint_0.0': its child link 'link_0.0' does not exist"),
        ("<parent link=\"link_1.0\"/>", "<parent link=\"link_x\"/>", "joint 'joint_2.0': its parent link 'link_x'"),
        ("<robot ", "<robot xmlns:xmlns=\"a\" xmlns:p=\"b\" p:c=\"d\" ", "urdf: the xml parser gave up"),
        // The tree.
        (
            link_0,
            "<link name=\"loose\"/>\n  <link name=\"link_0.0\">",
            "link 'palm_link': neither it nor link 'loose' has a",
        ),
        (
            "<child link=\"link_4.0\"/>",
            "<child link=\"link_1.0\"/>",
            "joint 'joint_4.0': link 'link_1.0' is a child of joint 'joint_1.0' already",
        ),
        ("<parent link=\"palm_link\"/>", "<parent link=\"link_3.0_pole\"/>", "link 'link_0.0': is its own ancestor"),
        (
            "</robot>",
            "<joint name=\"back\" type=\"fixed\"><parent link=\"link_0.0\"/><child link=\"palm_link\"/></joint></robot>",
            "robot: no root",
        ),
        // Joints.
        (ROLL_3, "<joint name=\"joint_2.0\" type=\"revolute\">", "joint 'joint_2.0': defined twice"),
        (ROLL_3, "<joint name=\"\" type=\"revolute\">", "joint '': a name needs"),
        (
            ROLL_3,
            "<joint name=\"joint_3.0\" type=\"prismatic\">",
            "joint 'joint_3.0': type 'prismatic' is not supported",
        ),
        (
            ROLL_3,
            "<joint name=\"joint_3.0\" type=\"continuous\">",
            "joint 'joint_3.0': type 'continuous' is not supported",
        ),
        (ROLL_3, "<joint name=\"joint_3.0\" type=\"floating\">", "joint 'joint_3.0': type 'floating' is not supported"),
        (LIMIT_0, "", "joint 'joint_0.0': limits 0 to 0 leave no room"),
        ("lower=\"-0.47\"", "lower=\"0.47\"", "joint 'joint_0.0': limits 0.47 to 0.47 leave no room"),
        ("lower=\"-0.47\"", "lower=\"-inf\"", "joint 'joint_0.0': limits -inf to 0.47 must be finite"),
        ("upper=\"0.47\"", "upper=\"NaN\"", "joint 'joint_0.0': limits -0.47 to NaN must be finite"),
        (
            "upper=\"0.47\"",
            "upper=\"26.93\"",
            "joint 'joint_0.0': limits -0.47 to 26.93 must be finite angles in radians",
        ),
        ("velocity=\"7\"", "velocity=\"0\"", "joint 'joint_0.0': velocity limit 0"),
        ("velocity=\"7\"", "velocity=\"inf\"", "joint 'joint_0.0': velocity limit inf"),
        ("<axis xyz=\"0 0 1\"/>", "<axis xyz=\"0 0 0\"/>", "joint 'joint_0.0': axis [0.0, 0.0, 0.0] has no direction"),
        ("<axis xyz=\"0 0 1\"/>", "<axis xyz=\"0 NaN 1\"/>", "joint 'joint_0.0': axis"),
        ("<axis xyz=\"0 0 1\"/>", "<axis xyz=\"0 1e300 1\"/>", "joint 'joint_0.0': axis"),
        (ORIGIN_3, "<origin xyz=\"0 0 38.4\"/>", "joint 'joint_3.0': origin xyz [0.0, 0.0, 38.4] must be finite and"),
        (ORIGIN_3, "<origin xyz=\"0 0 NaN\"/>", "joint 'joint_3.0': origin xyz"),
        (ORIGIN_3, "<origin xyz=\"0 0 0.0384\" rpy=\"0 0 90\"/>", "joint 'joint_3.0': origin rpy [0.0, 0.0, 90.0]"),
        (ORIGIN_3, "<origin xyz=\"0 0 0.0384\" rpy=\"0 0 inf\"/>", "joint 'joint_3.0': origin rpy"),
        (LIMIT_0, &format!("{LIMIT_0}<mimic joint=\"joint_1.0\"/>"), "joint 'joint_0.0': mimics 'joint_1.0'"),
        // Looks.
        ("rgba=\"0.17 0.175 0.185 1\"", "rgba=\"17 18 19 1\"", "material 'body': rgba [17.0, 18.0, 19.0, 1.0]"),
        ("<material name=\"body\"/>", "<material name=\"gold\"/>", "link 'palm_link': material 'gold' is not defined"),
        ("radius=\"0.006\"", "radius=\"-0.006\"", "link 'palm_link': a visual's size of -0.006"),
        ("radius=\"0.006\"", "radius=\"NaN\"", "link 'palm_link': a visual's size of NaN"),
    ];
    for (from, to, expected) in cases {
        assert_refused(&edit(&urdf, from, to), &description, expected);
    }
}

#[test]
fn urdf_of_version_1_2_without_limits_is_refused() {
    // There, limits that are left out mean unlimited.
    let (urdf, description) = right();
    let urdf = edit(&urdf, "<robot ", "<robot version=\"1.2\" ");
    HandModel::load(&urdf, &description).unwrap();
    assert_refused(
        &edit(&urdf, LIMIT_0, "<limit/>"),
        &description,
        "joint 'joint_0.0': limits -inf to inf must be finite",
    );
}

#[test]
fn broken_description_is_refused_by_name() {
    let (urdf, description) = right();
    let ring = "[[finger]]\nname = \"ring\"";
    let base = "base = \"link_12.0\"";
    let row = "\"joint_5.0\" = { terms = [{ from = \"middle.1\" }] }\n";
    let cases: &[(&str, &str, &str)] = &[
        // Syntax and keys.
        ("[joints]", "[joints", "description: line 14:"),
        ("side = \"right\"\n", "", "description: line 1: missing field `side`"),
        ("side = \"right\"", "side = \"both\"", "description: line 4: unknown variant `both`"),
        ("side = \"right\"", "side = \"right\"\nsize = 1", "description: line 5: unknown field `size`"),
        ("name = \"thumb\"", "name = \"big toe\"", "unknown variant `big toe`"),
        ("name = \"allegro-v4-right\"", "name = \"\"", "name: a name needs 1 to 64 printable bytes"),
        ("name = \"allegro-v4-right\"", "name = \"a\\nb\"", "name: a name needs 1 to 64 printable bytes"),
        ("{ from = \"index.0\" }", "{ form = \"index.0\" }", "unknown field `form`"),
        // Frame.
        ("radial = \"+y\"", "radial = \"+w\"", "unknown variant `+w`"),
        ("radial = \"+y\"", "radial = \"+z\"", "anatomical: radial, distal and palmar must be three different axes"),
        (
            "radial = \"+y\"",
            "radial = \"-y\"",
            "anatomical: these axes are those of the other hand, not of a right one",
        ),
        (
            "side = \"right\"",
            "side = \"left\"",
            "anatomical: these axes are those of the other hand, not of a left one",
        ),
        // Joints.
        (
            "\"joint_1.0\", \"joint_2.0\",",
            "\"joint_1.0\", \"joint_1.0\",",
            "joints.order: joint 'joint_1.0' is listed twice",
        ),
        (
            "\"joint_1.0\", \"joint_2.0\",",
            "\"joint_1.0\", \"joint_x\",",
            "joints.order: joint 'joint_x' is not in the urdf",
        ),
        ("\"joint_1.0\", \"joint_2.0\",", "\"joint_1.0\",", "joints.home: 16 values for the 15 joints"),
        (
            "\"joint_1.0\", \"joint_2.0\",",
            "\"joint_1.0\", \"joint_3.0_tip\",",
            "joints.order: joint 'joint_3.0_tip' is fixed in the urdf",
        ),
        (
            "order = [",
            "order = [\"a\", \"b\", \"c\", \"d\", \"e\", \"f\", \"g\", \"h\", \"i\", \"j\",",
            "joints.order: 26 joints are more than the 25 supported",
        ),
        ("kp = [", "kp = [1.0,", "joints.kp: 17 values for the 16 joints of joints.order"),
        ("kp = [\n  1.0", "kp = [\n  0.0", "joints.kp: 0 for joint 'joint_0.0' must be finite and above 0"),
        ("kd = [\n  0.05", "kd = [\n  -1.0", "joints.kd: -1 for joint 'joint_0.0' must be finite and not negative"),
        ("torque = [\n  0.23", "torque = [\n  inf", "joints.torque: inf for joint 'joint_0.0'"),
        ("acceleration = [\n  300.0", "acceleration = [\n  nan", "joints.acceleration: NaN for joint 'joint_0.0'"),
        (
            "home = [\n  0.0",
            "home = [\n  0.5",
            "joints.home: 0.5 rad for joint 'joint_0.0' is outside its limits -0.47 to 0.47",
        ),
        ("home = [\n  0.0", "home = [\n  nan", "joints.home: NaN rad for joint 'joint_0.0' is outside"),
        // Fingers.
        ("name = \"ring\"", "name = \"index\"", "finger 'index': described twice"),
        ("name = \"thumb\"", "name = \"little\"", "finger: no thumb"),
        (base, "base = \"link_99\"", "finger 'thumb': base link 'link_99' is not in the urdf"),
        (base, "base = \"link_1.0\"", "finger 'thumb': base link 'link_1.0' is not between the palm and its center"),
        (base, "base = \"link_15.0_pole\"", "finger 'thumb': base link 'link_15.0_pole' is not between"),
        ("center = \"link_15.0_tip\"", "center = \"tip\"", "finger 'thumb': center link 'tip' is not in the urdf"),
        (
            "center = \"link_15.0_tip\"",
            "center = \"link_14.0\"",
            "finger 'thumb': joints must be those that lead to its center 'link_14.0', from the palm outwards: joint_12.0 \
             joint_13.0 joint_14.0",
        ),
        (
            "pole = \"link_15.0_pole\"",
            "pole = \"link_3.0_pole\"",
            "finger 'thumb': joints must be those that lead to its pole",
        ),
        (
            "joints = [\"joint_12.0\", \"joint_13.0\",",
            "joints = [\"joint_13.0\", \"joint_12.0\",",
            "finger 'thumb': joints must",
        ),
        ("joints = [\"joint_12.0\", ", "joints = [", "finger 'thumb': joints must be those that lead to"),
        ("joints = [\"joint_12.0\",", "joints = [\"joint_0.0\",", "finger 'thumb': joints must be those that lead to"),
        (
            "joints = [\"joint_12.0\",",
            "joints = [\"joint_x\",",
            "finger 'thumb': joint 'joint_x' is not in joints.order",
        ),
        (
            "joints = [\"joint_12.0\",",
            "joints = [\"joint_0.0\", \"joint_1.0\", \"joint_12.0\",",
            "finger 'thumb': 6 joints; a finger needs 1 to 5",
        ),
        (
            "joints = [\"joint_12.0\", \"joint_13.0\", \"joint_14.0\", \"joint_15.0\"]",
            "joints = []",
            "finger 'thumb': 0 joints; a finger needs 1 to 5",
        ),
        ("phalanges = [0.057,", "phalanges = [57.0,", "finger 'thumb': phalanges [57.0, 0.051, 0.054] must be lengths"),
        ("phalanges = [0.057,", "phalanges = [nan,", "finger 'thumb': phalanges"),
        ("phalanges = [0.057,", "phalanges = [", "description: line"),
        // A joint that two fingers share: the same chain under another name.
        (
            ring,
            "[[finger]]\nname = \"little\"\njoints = [\"joint_4.0\", \"joint_5.0\", \"joint_6.0\", \"joint_7.0\"]\nbase = \
             \"link_10.0\"\ncenter = \"link_7.0_tip\"\npole = \"link_7.0_pole\"\nphalanges = [0.05, 0.04, 0.03]\n\n[[finger]]\n\
             name = \"ring\"",
            "finger 'little': base link 'link_10.0' is not between",
        ),
        // The wrist, in metres.
        ("-0.095]", "-95.0]", "anatomical.wrist: [0.0, 0.0, -95.0] must be within 1 m of the root link"),
        ("-0.095]", "nan]", "anatomical.wrist: [0.0, 0.0, NaN] must be within"),
        // Joint maps.
        (row, "", "joint_map.carry: no row for joint 'joint_5.0'"),
        (
            row,
            &format!("{row}\"joint_x\" = {{}}\n"),
            "joint_map.index: row for joint 'joint_x', which is not in joints.order",
        ),
        (row, &row.repeat(2), "description: line"),
        ("from = \"middle.1\"", "from = \"middle.4\"", "rows.\"joint_5.0\": 'middle.4' is no master joint"),
        ("from = \"middle.1\"", "from = \"pinkie.1\"", "'pinkie.1' is no master joint"),
        ("from = \"middle.1\"", "from = \"middle\"", "'middle' is no master joint"),
        ("from = \"middle.1\"", "from = \"middle.+1\"", "'middle.+1' is no master joint"),
        (
            "{ from = \"middle.1\" }",
            "{ from = \"middle.1\", gain = nan }",
            "rows.\"joint_5.0\": gain NaN must be within 100",
        ),
        ("{ from = \"middle.1\" }", "{ from = \"middle.1\", gain = 1e9 }", "gain 1000000000 must be within 100"),
        ("{ from = \"middle.1\" }", "{ from = \"middle.1\", above = inf }", "above inf must be within 6.3"),
        ("offset = 3.141592653589793", "offset = 180.0", "rows.\"joint_13.0\": offset 180 must be within 6.3"),
        ("extends = \"index\"", "extends = \"nothing\"", "extends 'nothing', which does not exist"),
        ("extends = \"index\"", "extends = \"carry\"", "extends itself by way of others"),
        ("[joint_map.role]\nextends = \"index\"", "[joint_map.role]\nextends = \"role\"", "extends itself"),
        ("[joint_map.carry]", "[joint_map.\"\"]", "joint_map.: a name needs 1 to 64 printable bytes"),
    ];
    for (from, to, expected) in cases {
        assert_refused(&urdf, &edit(&description, from, to), expected);
    }
}

#[test]
fn urdf_and_description_must_fit_each_other() {
    let (urdf, description) = right();
    let (left_urdf, left_description) = allegro_v4_texts(HandSide::Left);
    let expected = "finger 'index': its base (-0.0449 m) is not on the thumb's side of the middle finger's";
    assert_refused(left_urdf, &description, expected);
    assert_refused(&urdf, left_description, expected);

    // A joint that moves, in the urdf alone: in a finger, and beside the fingers.
    let wrist = "<link name=\"extra\"/><joint name=\"wrist\" type=\"revolute\"><parent link=\"extra\"/>\
                 <child link=\"palm_link\"/><axis xyz=\"0 1 0\"/><limit lower=\"-1\" upper=\"1\" velocity=\"1\"/></joint></robot>";
    assert_refused(
        &edit(&urdf, "</robot>", wrist),
        &description,
        "lead to its center 'link_15.0_tip', from the palm outwards: wrist",
    );
    let beside = wrist.replace("extra\"/><child link=\"palm_link", "palm_link\"/><child link=\"extra");
    assert_refused(&edit(&urdf, "</robot>", &beside), &description, "joint 'wrist' moves but is not listed");

    // A joint in the order but in no finger.
    let start = description.find("[[finger]]\nname = \"ring\"").unwrap();
    let end = description.find("# M_Q").unwrap();
    let without_ring = edit(&description, &description[start..end], "");
    assert_refused(&urdf, &without_ring, "joint 'joint_8.0' is used by 0 fingers ()");

    // Two fingers on the same joints: `little` copies `ring`, its base one link back so that the order holds.
    let little = edit(&edit(&description[start..end], "\"ring\"", "\"little\""), "link_9.0", "palm_link");
    let order = |error: &str| assert_refused(&urdf, &edit(&description, "# M_Q", &format!("{little}# M_Q")), error);
    order("finger 'ring': its base (-0.0449 m) is not on the thumb's side of the little finger's (0.0000 m)");

    // A thumb alone.
    let first = description.find("[[finger]]\nname = \"index\"").unwrap();
    assert_refused(&urdf, &edit(&description, &description[first..end], ""), "finger: a thumb alone cannot grasp");
}

#[test]
fn shared_joints_are_refused() {
    // An offset link behind the ring fingertip gives a second finger on the same joints.
    let (urdf, description) = right();
    let urdf = edit(
        &urdf,
        "</robot>",
        "<link name=\"wing\"/><joint name=\"wing\" type=\"fixed\"><parent link=\"link_11.0\"/><child link=\"wing\"/>\
         <origin xyz=\"0 -0.05 0\"/></joint></robot>",
    );
    let little = "[[finger]]\nname = \"little\"\njoints = [\"joint_8.0\", \"joint_9.0\", \"joint_10.0\", \"joint_11.0\"]\n\
                  base = \"wing\"\ncenter = \"wing\"\npole = \"wing\"\nphalanges = [0.05, 0.04, 0.03]\n\n# M_Q";
    let description = edit(&description, "# M_Q", little);
    assert_refused(&urdf, &description, "finger: joint 'joint_8.0' is used by 2 fingers (ring, little)");
}

#[test]
fn oversized_and_deeply_nested_texts_are_refused() {
    let (urdf, description) = right();
    let padding = " ".repeat(1 << 20);
    assert_refused(&format!("{urdf}{padding}"), &description, "are more than the 1048576 allowed");
    assert_refused(&urdf, &format!("{description}{padding}"), "are more than the 1048576 allowed");
    assert!(matches!(HandModel::load(&padding, &format!("{padding} ")), Err(HandError::DescriptionSyntax(_))));

    let deep = |open: &str, close: &str| format!("<robot>{}{}</robot>", open.repeat(40_000), close.repeat(40_000));
    assert_refused(&deep("<a>", "</a>"), &description, "urdf: line 1: elements are nested more than 24 deep");
    // Ways to hide the nesting from a lexer that reads differently than the parser.
    for (open, close) in [
        ("<a><!--</a>-->", "</a>"),
        ("<a b=\"</a>\">", "</a>"),
        ("<a b></x=\"\">", "</a>"),
        ("<a><![CDATA[</a>]]>", "</a>"),
        ("<a><?b </a>?>", "</a>"),
    ] {
        assert_refused(&deep(open, close), &description, "urdf: line 1:");
    }
    assert_refused(&urdf, &format!("a = {}", "[".repeat(100_000)), "description: line 1:");
    let links: String = (0..300).map(|index| format!("<link name=\"l{index}\"/>")).collect();
    assert_refused(
        &edit(&urdf, "</robot>", &format!("{links}</robot>")),
        &description,
        "links are more than the 256 allowed",
    );
    let long = "n".repeat(200);
    assert_refused(
        &edit(&urdf, "<link name=\"link_0.0\">", &format!("<link name=\"{long}\">")),
        &description,
        "a name needs 1 to 128 bytes",
    );
}

#[test]
fn what_a_users_urdf_may_have() {
    let (urdf, description) = right();
    let reference = HandModel::load(&urdf, &description).unwrap();
    let q: Vec<f64> = reference.joints.iter().map(|joint| 0.3 * joint.lower + 0.7 * joint.upper).collect();

    // A split fixed offset and an axis that is not of unit length fold into the same kinematics; a mesh is left out
    // with a warning; a capsule becomes three shapes; a material may be defined where it is first used.
    let mesh = "<visual><geometry><mesh filename=\"package://a/palm.stl\"/></geometry></visual>";
    let capsule = "<visual><geometry><capsule radius=\"0.01\" length=\"0.04\"/></geometry>\
                   <material name=\"red\"><color rgba=\"1 0 0 1\"/></material></visual>\
                   <visual><geometry><sphere radius=\"0.01\"/></geometry><material name=\"red\"/></visual>";
    let split = "<parent link=\"between\"/>\n    <child link=\"link_3.0\"/>\n    <origin xyz=\"0 0 0.0184\"";
    let changed = edit(&urdf, "<visual>", &format!("{mesh}<visual>"));
    let changed =
        edit(&changed, "<link name=\"link_3.0_pole\"/>", &format!("<link name=\"link_3.0_pole\">{capsule}</link>"));
    let changed = edit(
        &changed,
        "<parent link=\"link_2.0\"/>\n    <child link=\"link_3.0\"/>\n    <origin xyz=\"0 0 0.0384\"",
        split,
    );
    let between = "<link name=\"between\"/><joint name=\"between\" type=\"fixed\"><origin xyz=\"0 0 0.02\"/>\
                   <parent link=\"link_2.0\"/><child link=\"between\"/></joint></robot>";
    let changed = edit(&changed, "</robot>", between);
    let changed = edit(&changed, "<axis xyz=\"0 1 0\"/>", "<axis xyz=\"0 25 0\"/>");
    let changed = edit(&changed, "<robot ", "<robot xmlns:xacro=\"http://ros.org/wiki/xacro\" ");
    let hand = HandModel::load(&changed, &description).unwrap();
    for (a, b) in hand.fingers.iter().zip(&reference.fingers) {
        assert!((a.tip(&a.select(&q), TipFrame::Pole) - b.tip(&b.select(&q), TipFrame::Pole)).amax() < 1e-15);
    }
    assert_eq!(hand.warnings.len(), 1);
    assert!(
        hand.warnings[0].contains("link 'palm_link': mesh 'package://a/palm.stl' is not drawn"),
        "{:?}",
        hand.warnings
    );
    let visuals = &hand.links[hand.link("link_3.0_pole").unwrap()].visuals;
    assert_eq!(visuals.len(), 4);
    assert_eq!(visuals[0].shape, Shape::Cylinder { radius: 0.01, length: 0.04 });
    assert_eq!((visuals[1].origin.translation.z, visuals[2].origin.translation.z), (-0.02, 0.02));
    assert!(visuals.iter().all(|visual| visual.rgba == [1.0, 0.0, 0.0, 1.0]));
}
