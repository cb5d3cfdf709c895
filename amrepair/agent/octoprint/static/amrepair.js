/* The tab: shows what the plugin tells, and hands on what is pressed. */
$(function () {
  var LOOKS = { primary: "btn-primary", warning: "btn-warning", error: "btn-danger" };

  function AmrepairTab() {
    var self = this;
    ["doing", "who", "refused", "page"].forEach(function (name) { self[name] = ko.observable(""); });
    ["agent", "prompt", "printing"].forEach(function (name) { self[name] = ko.observable(false); });
    ["lines", "buttons", "said"].forEach(function (name) { self[name] = ko.observableArray([]); });
    self.share = ko.observable("0%");
    var asked = null;

    self.press = function (call) {
      self.refused("");
      return OctoPrint.postJson("plugin/amrepair/press", call).fail(function (answer) {
        var told = answer.responseJSON;
        self.refused((told && told.error) || "OctoPrint does not answer.");
      });
    };

    self.take = function (state) {
      var print = state.print, program = state.program, prompt = state.prompt;
      self.agent(state.agent);
      self.who(state.agent ? "The agent is here." : "No agent is here.");
      self.doing(state.agent ? state.doing : "");
      self.prompt(!!prompt);
      self.lines(prompt ? prompt.lines : []);
      self.buttons((prompt ? prompt.buttons : []).map(function (one) {
        return {
          label: one.label, look: LOOKS[one.colour] || "",
          press: function () { self.press(one.call); }
        };
      }));
      self.printing(!!(program && !program.over && print && print.rests));
      self.share(program && program.total ? (100 * program.done / program.total) + "%" : "0%");
      self.said(state.said.slice().reverse());
      var page = state.page ? BASEURL + "plugin/amrepair/live/" : "";
      if (page !== self.page()) self.page(page);
      var question = prompt ? JSON.stringify(prompt) : null;
      if (question && question !== asked) {
        new PNotify({ title: "amrepair", text: $("<i>").text(prompt.lines[0]).html(), type: "info" });
      }
      asked = question;
    };

    self.ask = function () { OctoPrint.get("plugin/amrepair/state").done(self.take); };
    self.onStartupComplete = self.onServerReconnect = self.onUserLoggedIn = self.ask;
    self.onDataUpdaterPluginMessage = function (plugin, state) {
      if (plugin === "amrepair") self.take(state);
    };
  }

  OCTOPRINT_VIEWMODELS.push({ construct: AmrepairTab, elements: ["#amrepair_tab"] });
});
